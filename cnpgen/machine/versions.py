"""Versions of cnpgen and of its numerical libraries."""

from functools import cache

__version__ = "1.0.0"

DOCUMENTATION_URL = "https://cnpgen.example.org/"  # the only place of the address, which the publisher replaces


@cache
def versions() -> dict[str, str]:
    """Return the versions of cnpgen, Python and the numerical libraries."""
    import platform

    names = ("numpy", "casadi", "pin", "coal", "h5py", "joblib")
    machine = f"{platform.system()} {platform.machine()}"
    found = {"cnpgen": __version__, "python": platform.python_version(), "platform": machine}
    return found | {name: installed_version(name) or "not installed" for name in names}


def installed_version(project: str) -> str:
    """Return the version of an installed distribution, or an empty text."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(project)
    except PackageNotFoundError:
        return ""
