"""What this machine has of what cnpgen needs, and what to do about the rest.

Nothing is imported before it is checked, so that a broken library is a line in the report and not a traceback.
"""

import importlib
import importlib.metadata
import os
import platform
import shutil
import sys
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from cnpgen.machine.threads import users_environment

NEEDED = {  # module -> the project on PyPI that has it
    "numpy": "numpy",
    "scipy": "scipy",
    "casadi": "casadi",
    "pinocchio": "pin",
    "coal": "coal",
    "h5py": "h5py",
    "joblib": "joblib",
    "psutil": "psutil",
    "tqdm": "tqdm",
    "daqp": "daqp",
    "threadpoolctl": "threadpoolctl",
}
OPTIONAL = {"matplotlib": "matplotlib"}

VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "LOKY_MAX_CPU_COUNT",
    "CC",
    "CNPGEN_CACHE",
    "XDG_CACHE_HOME",
    "PYTHONPATH",
)

ENOUGH_DISK = 10**9  # bytes

# What only this project of a name that is easily mistaken has.
_TELLTALES = {"pinocchio": "buildModelFromUrdf", "coal": "Box"}

_VECTOR_FLAGS = (("avx512f", "avx512"), ("avx2", "avx2"), ("avx", "avx"), ("asimd", "neon"), ("sse2", "sse2"))


@dataclass(kw_only=True)
class _Findings:
    """What is found on the way."""

    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class MachineReport:
    """What a machine has.

    Attributes:
        cnpgen: Version of cnpgen.
        python: Version of Python.
        executable: Its path.
        platform: Operating system and processor.
        cores: Cores that this process may use.
        cores_present: Cores of the machine.
        vector: The widest vector instructions: "avx512", "avx2", "avx", "neon", "sse2" or "unknown".
        libraries: Project -> version, "missing" or "broken".
        hdf5: Version of the HDF5 library.
        environment: The variables that matter and that the user has set.
        compiler: The C compiler and its version, empty if there is none.
        backend: The kernels that would run, empty if none.
        backend_reason: Why.
        cache_folder: Where kernels are cached.
        cache_writable: Whether they can be.
        cache_used: Whether those that are there are loaded: only if nobody else may change them.
        recipes: How many recipes were found where.
        free_bytes: Free disk space in the working directory; 0 where it is gone.
        problems: What keeps cnpgen from working, each with its remedy.
        notes: What makes it slower, or is worth knowing.
    """

    cnpgen: str
    python: str
    executable: str
    platform: str
    cores: int
    cores_present: int
    vector: str
    libraries: dict[str, str]
    hdf5: str
    environment: dict[str, str]
    compiler: str
    backend: str
    backend_reason: str
    cache_folder: str
    cache_writable: bool
    cache_used: bool
    recipes: str
    free_bytes: int
    problems: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """Whether everything that cnpgen needs works."""
        return not self.problems

    def to_dict(self) -> dict[str, Any]:
        """Return the report for JSON."""
        return {"ok": self.ok, **asdict(self)}


def check_machine() -> MachineReport:
    """Look at this machine; never raises because of what it finds."""
    found = _Findings()
    libraries = _check_libraries(found)
    cores, present = _check_cores(found)
    theirs = users_environment()
    cache = _or(_cache_folder, "")
    backend, reason, writable = _check_backend(found, cache)
    cache_used = _check_cache(found, cache)
    return MachineReport(
        cnpgen=_version_of("cnpgen"),
        python=platform.python_version(),
        executable=sys.executable,
        platform=platform.platform(),
        cores=cores,
        cores_present=present,
        vector=vector_instructions(),
        libraries=libraries,
        hdf5=_or(_hdf5_version, "unknown"),
        environment={name: theirs[name] for name in VARIABLES if theirs.get(name)},
        compiler=_or(_compiler, ""),
        backend=backend,
        backend_reason=reason,
        cache_folder=cache,
        cache_writable=writable,
        cache_used=cache_used,
        recipes=_check_recipes(found),
        free_bytes=_check_disk(found),
        problems=tuple(found.problems),
        notes=tuple(found.notes),
    )


def _or(look: Callable[[], str], otherwise: str) -> str:
    """Return what there is to see, or something else where the libraries for looking are broken."""
    try:
        return look()
    except Exception:  # noqa: BLE001 - broken libraries raise anything; they are reported by _check_libraries
        return otherwise


def _one_line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


def _version_of(project: str) -> str:
    try:
        return importlib.metadata.version(project)
    except importlib.metadata.PackageNotFoundError:
        return "not installed, run from its source"


def _check_libraries(found: _Findings) -> dict[str, str]:
    versions = {}
    for module, project in NEEDED.items():
        versions[project], problem = _try_library(module, project)
        found.problems += [problem] if problem else []
    for module, project in OPTIONAL.items():
        versions[project], problem = _try_library(module, project)
        found.notes += [f"{problem}, for 'cnpgen inspect --plot' only"] if problem else []
    return versions


def _try_library(module: str, project: str) -> tuple[str, str]:
    """Import a library; return its version and what is wrong with it, if anything."""
    install = f"{sys.executable} -m pip install"
    try:
        imported = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name == module:
            return "missing", f"{project} is not installed: run '{install} {project}'"
        return "broken", f"{project} cannot be imported ({error}): run '{install} --force-reinstall {project}'"
    except Exception as error:  # noqa: BLE001 - a broken library may raise anything
        return (
            "broken",
            f"{project} cannot be imported ({_one_line(error)}): run '{install} --force-reinstall {project}'",
        )
    telltale = _TELLTALES.get(module)
    if telltale and not hasattr(imported, telltale):
        remedy = f"run '{sys.executable} -m pip uninstall {module}', then '{install} --force-reinstall {project}'"
        return "broken", f"the module {module!r} that is installed is another project of that name: {remedy}"
    return str(getattr(imported, "__version__", "")) or _version_of(project), ""


def _check_cores(found: _Findings) -> tuple[int, int]:
    """Return the cores that are available and those that are there."""
    present = os.cpu_count() or 1
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else present
    try:
        from joblib import cpu_count

        granted = int(cpu_count())  # knows the limits of containers, too
    except Exception:  # noqa: BLE001 - reported by _check_libraries
        granted = available
    if granted < available:
        found.notes.append(f"this container may use {granted} of {available} cores: run with workers={granted}")
    return min(granted, available), present


def vector_instructions() -> str:
    """Name the widest vector instructions of the processor."""
    if platform.machine().lower() in {"arm64", "aarch64"}:
        return "neon"
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").lower().splitlines()
    except OSError:
        return "unknown"
    flags = next((set(line.split()) for line in lines if line.startswith(("flags", "features"))), set[str]())
    return next((name for flag, name in _VECTOR_FLAGS if flag in flags), "unknown")


def _hdf5_version() -> str:
    import h5py

    return str(h5py.version.hdf5_version)


def _compiler() -> str:
    from cnpgen.kernels.compiler import compiler_version, find_compiler

    path = find_compiler()
    return f"{path}, {compiler_version(path)}" if path else ""


def _cache_folder() -> str:
    from cnpgen.kernels.cache import default_cache_folder

    return str(default_cache_folder())


def _check_backend(found: _Findings, cache: str) -> tuple[str, str, bool]:
    """Choose a backend as a run would; return it, the reason and whether the cache can be written."""
    try:
        from cnpgen.kernels.library import choose_backend

        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            backend, folder = choose_backend()
    except Exception as error:  # noqa: BLE001 - broken libraries raise anything
        text = _one_line(error)
        found.problems += [] if found.problems else [f"no backend works ({text}): reinstall cnpgen"]
        return "", text, False
    found.notes += [str(warning.message) for warning in caught]
    if str(folder) != cache:
        shutil.rmtree(folder, ignore_errors=True)  # it was made for this look only
    reason = (
        "a test kernel was compiled and computes what it should" if backend == "compiled" else "no C compiler works"
    )
    return backend, reason, str(folder) == cache


def _check_cache(found: _Findings, cache: str) -> bool:
    """Return whether the kernels in the cache may be loaded, and note those that may not."""
    from cnpgen.kernels.cache import distrusted, distrusted_files

    if not cache or not Path(cache).is_dir() or distrusted(Path(cache)):  # the choice of a backend has said why
        return False
    if files := distrusted_files(Path(cache)):
        found.notes.append(
            f"kernels in the cache that others may have changed are not used ({len(files)}): delete them, the first one"
            f" is {files[0]}"
        )
    return True


def _check_recipes(found: _Findings) -> str:
    """Load every shipped dataset recipe with its robot."""
    try:
        from cnpgen.errors import PluginError
        from cnpgen.make.load import load_dataset_recipe
        from cnpgen.problems.robot import load_robot
        from cnpgen.schema.catalogue import list_recipes, recipes_root

        names, without = list(list_recipes("dataset")), []
        for name in names:
            try:
                load_robot(load_dataset_recipe(name).pipeline.problem)
            except PluginError:
                without.append(name)
    except Exception as error:  # noqa: BLE001 - broken libraries raise anything
        text = _one_line(error)
        found.problems += [] if found.problems else [f"the shipped recipes cannot be loaded ({text}): reinstall cnpgen"]
        return f"cannot be loaded: {text}"
    if not names:
        found.problems.append(f"there are no recipes in {recipes_root()}: reinstall cnpgen")
    more = f", but for those of {', '.join(without)}: pip install 'cnpgen[robots]'" if without else ""
    return f"{len(names)} datasets in {recipes_root()}, their robots load{more}"


def _check_disk(found: _Findings) -> int:
    try:
        free = shutil.disk_usage(Path.cwd()).free
    except OSError as error:
        found.notes.append(f"the working directory cannot be looked at ({error.strerror}): go to another one")
        return 0
    if free < ENOUGH_DISK:
        found.notes.append(
            f"only {free / 1e6:,.0f} MB are free in {Path.cwd()}: choose another out= for large datasets"
        )
    return free
