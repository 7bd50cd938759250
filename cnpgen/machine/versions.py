"""Versions of cnpgen and of its numerical libraries."""

from functools import cache

__version__ = "1.0.0"

DOCUMENTATION_URL = "https://cnpgen.example.org/"  # the only place of the address, which the publisher replaces


@cache
def versions() -> dict[str, str]:
    """Return the versions of cnpgen, Python and the numerical libraries."""
    import platform
    from importlib.metadata import PackageNotFoundError, version

    names = ("numpy", "casadi", "pin", "coal", "h5py", "joblib")
    machine = f"{platform.system()} {platform.machine()}"
    found = {"cnpgen": __version__, "python": platform.python_version(), "platform": machine}
    for name in names:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
