"""Paths of the environment with other builds of the libraries of cnpgen, such as those of a ROS shell."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

# Python searches PYTHONPATH before the packages of an environment, and the loader
# LD_LIBRARY_PATH before the libraries beside a module.
MODULES = "pinocchio", "coal", "hppfcl", "eigenpy", "casadi", "numpy", "scipy", "h5py"
LIBRARIES = "pinocchio", "coal", "hpp-fcl", "eigenpy", "casadi", "boost_python", "hdf5"
LOADER_VARIABLES = "LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH"
REMEDY = "run cnpgen with 'env -u PYTHONPATH -u LD_LIBRARY_PATH cnpgen ...' ('cnpgen docs beside-ros-2')"


def foreign_paths() -> list[str]:
    """Describe the entries of PYTHONPATH and LD_LIBRARY_PATH that have a library which cnpgen uses."""
    described = []
    for variable in ("PYTHONPATH", *LOADER_VARIABLES):
        names = MODULES if variable == "PYTHONPATH" else LIBRARIES
        for entry in filter(None, os.environ.get(variable, "").split(os.pathsep)):
            found = [name for name in names if _has(Path(entry), variable, name)]
            if found:
                described.append(f"{variable} names {entry}, which has {found[0]}")
    return described


def _has(folder: Path, variable: str, name: str) -> bool:
    if variable == "PYTHONPATH":
        return (folder / name / "__init__.py").is_file()
    return any(folder.glob(f"lib{name}*.so*")) or any(folder.glob(f"lib{name}*.dylib"))


def foreign_path_hint() -> str:
    """Return the foreign paths with a remedy, or an empty text."""
    paths = foreign_paths()
    return f"{'; '.join(paths)}: {REMEDY}" if paths else ""


@contextmanager
def import_errors_with_hint() -> Iterator[None]:
    """Add the foreign paths, if any, to the message of an ImportError that the block raises."""
    try:
        yield
    except ImportError as error:
        hint = foreign_path_hint()
        if hint and hint not in str(error):
            error.msg = f"{error.msg}; {hint}"
        raise
