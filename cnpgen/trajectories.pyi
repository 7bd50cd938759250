from typing import Any

from cnpgen.trajectory.fit import fit_motion as fit_motion
from cnpgen.trajectory.fit import largest_error as largest_error

def __getattr__(name: str) -> Any: ...  # names of add-ons
