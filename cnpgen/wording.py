"""Numbers of things in messages."""


def counted(number: int, noun: str) -> str:
    """Write a number of things: ``"1 row"``, ``"120,000 rows"``."""
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"
