from typing import Any

def __getattr__(name: str) -> Any: ...  # names of add-ons
