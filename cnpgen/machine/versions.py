"""Versions of cnpgen and of its numerical libraries, and the processor."""

from functools import cache
from pathlib import Path

__version__ = "1.0.0"

DOCUMENTATION_URL = ""
"""Address of the documentation site, with a slash at its end; empty until it is published.

This is the only place of the address. Help, errors and metadata name it only if it is set.
"""


@cache
def versions() -> dict[str, str]:
    """Return the versions of cnpgen, Python and the numerical libraries."""
    import platform

    names = ("numpy", "casadi", "pin", "coal", "h5py", "joblib")
    machine = f"{platform.system()} {platform.machine()}"
    found = {
        "cnpgen": __version__,
        "python": platform.python_version(),
        "platform": machine,
    }
    return found | {name: installed_version(name) or "not installed" for name in names}


def installed_version(project: str) -> str:
    """Return the version of an installed distribution, or an empty text."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(project)
    except PackageNotFoundError:
        return ""


def processor_entry(*names: str) -> str:
    """Return the first entry of the processor with one of the lower-case names in Linux, or an empty text."""
    try:
        lines = (
            Path("/proc/cpuinfo")
            .read_text(encoding="utf-8", errors="replace")
            .splitlines()
        )
    except OSError:
        return ""
    return next(
        (line.partition(":")[2] for line in lines if line.lower().startswith(names)), ""
    )
