"""Check of this machine: libraries, compiler, cores, cache and recipes, with a remedy for every problem.

A library is imported only within its check, so that a broken library is reported and
not raised as an exception.
"""

import importlib
import os
import platform
import shutil
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

from cnpgen.documents import JsonObject
from cnpgen.errors import PluginError, RecipeError, counted, nearest
from cnpgen.machine.threads import users_environment
from cnpgen.machine.versions import installed_version, processor_entry
from cnpgen.schema.entry_points import entry_points
from cnpgen.schema.foreign_paths import foreign_path_hint
from cnpgen.schema.registry import CONTRACTS, PROJECT, load

REQUIRED_MODULES = (
    "numpy", "scipy", "casadi", "pinocchio", "coal", "h5py", "joblib", "psutil", "tqdm", "daqp", "threadpoolctl",
    "llvmlite",
)  # fmt: skip
OPTIONAL_MODULES = ("matplotlib",)
PROJECTS = {"pinocchio": "pin"}  # on PyPI, where it is not called like its module

VARIABLES = (
    "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS", "LOKY_MAX_CPU_COUNT",
    "CC", "CNPGEN_CACHE", "XDG_CACHE_HOME", "PYTHONPATH", "LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH",
)  # fmt: skip

MIN_DISK_BYTES = 10**9

# Attributes that distinguish these projects from others with the same module name.
_DISTINCTIVE_ATTRIBUTES = {"pinocchio": "buildModelFromUrdf", "coal": "Box"}

_VECTOR_FLAGS = (
    ("avx512f", "avx512"),
    ("avx2", "avx2"),
    ("avx", "avx"),
    ("asimd", "neon"),
    ("sse2", "sse2"),
)


@dataclass(kw_only=True)
class _Findings:
    """Problems and notes of all checks."""

    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class MachineReport:
    """Properties and problems of a machine.

    Attributes:
        cnpgen: Version of cnpgen.
        python: Version of Python.
        executable: Path of the Python interpreter.
        platform: Operating system and processor.
        cores: Number of cores that this process may use.
        cores_present: Number of cores of the machine.
        vector: Widest vector instructions: "avx512", "avx2", "avx", "neon", "sse2" or
            "unknown".
        libraries: Project -> version, "missing" or "broken".
        hdf5: Version of the HDF5 library.
        environment: Relevant environment variables set by the user.
        generator: Generator of machine code and its processor; empty if it does not
            work.
        handwritten: Origin of the handwritten C code: the package, or a compiler at first
            use; "missing" without both.
        compiler: C compiler and its version; empty if there is none.
        backend: Backend of the kernels; empty if none works.
        backend_reason: Reason for the choice of the backend.
        cache_folder: Folder of cached kernels.
        cache_writable: Whether kernels can be cached.
        cache_used: Whether cached kernels are loaded; they are not if other users may
            change them.
        plugins: Plug-ins of other packages, with their groups and packages.
        recipes: Number and folder of the recipes.
        free_bytes: Free disk space in the working directory [bytes]; 0 if it does not
            exist.
        problems: Problems that prevent cnpgen from working, each with a remedy.
        notes: Remarks, for example on a lower speed.
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
    generator: str
    handwritten: str
    compiler: str
    backend: str
    backend_reason: str
    cache_folder: str
    cache_writable: bool
    cache_used: bool
    plugins: tuple[str, ...]
    recipes: str
    free_bytes: int
    problems: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """Whether there are no problems."""
        return not self.problems

    def to_dict(self) -> JsonObject:
        """Return the report for JSON."""
        return {"ok": self.ok, **asdict(self)}


def check_machine() -> MachineReport:
    """Check this machine; problems are reported and not raised."""
    findings = _Findings()
    libraries = _check_libraries(findings)
    cores, present = _check_cores(findings)
    environment = users_environment()
    cache = _value_or(_cache_folder, "")
    backend, reason, writable = _check_backend(findings, cache)
    cache_used = _check_cache(findings, cache)
    handwritten, compiler = _check_handwritten(findings)
    return MachineReport(
        cnpgen=_version_of("cnpgen"),
        python=platform.python_version(),
        executable=sys.executable,
        platform=platform.platform(),
        cores=cores,
        cores_present=present,
        vector=vector_instructions(),
        libraries=libraries,
        hdf5=_value_or(_hdf5_version, "unknown"),
        environment={
            name: environment[name] for name in VARIABLES if environment.get(name)
        },
        generator=_value_or(_generator, ""),
        handwritten=handwritten,
        compiler=compiler,
        backend=backend,
        backend_reason=reason,
        cache_folder=cache,
        cache_writable=writable,
        cache_used=cache_used,
        plugins=tuple(_check_plugins(findings)),
        recipes=_check_recipes(findings),
        free_bytes=_check_disk(findings),
        problems=tuple(findings.problems),
        notes=tuple(findings.notes),
    )


def _value_or(read: Callable[[], str], default: str) -> str:
    """Return the result of ``read``, or a default if a library is broken."""
    try:
        return read()
    except Exception:  # noqa: BLE001 - broken libraries raise anything; they are reported by _check_libraries
        return default


def _one_line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


def _version_of(project: str) -> str:
    return installed_version(project) or "not installed, run from its source"


def _check_libraries(findings: _Findings) -> dict[str, str]:
    versions = {}
    for module in REQUIRED_MODULES:
        project = PROJECTS.get(module, module)
        versions[project], problem = _try_library(module, project)
        findings.problems += [problem] if problem else []
    for module in OPTIONAL_MODULES:
        versions[module], problem = _try_library(module, module)
        findings.notes += (
            [f"{problem}, for 'cnpgen inspect --plot' only"] if problem else []
        )
    if hint := foreign_path_hint():
        # Foreign paths are the probable cause of broken libraries, hence first; without
        # problems they are a note.
        (findings.problems if findings.problems else findings.notes).insert(0, hint)
    return versions


def _try_library(module: str, project: str) -> tuple[str, str]:
    """Import a library; return its version and a description of its problem, if any."""
    install = f"{sys.executable} -m pip install"
    try:
        imported = importlib.import_module(module)
    except Exception as error:  # noqa: BLE001 - a broken library may raise anything
        if isinstance(error, ModuleNotFoundError) and error.name == module:
            return "missing", f"{project} is not installed: run '{install} {project}'"
        reason = (
            str(error) if isinstance(error, ModuleNotFoundError) else _one_line(error)
        )
        return (
            "broken",
            f"{project} cannot be imported ({reason}): run '{install} --force-reinstall {project}'",
        )
    attribute = _DISTINCTIVE_ATTRIBUTES.get(module)
    if attribute and not hasattr(imported, attribute):
        remedy = f"run '{sys.executable} -m pip uninstall {module}', then '{install} --force-reinstall {project}'"
        return (
            "broken",
            f"the module {module!r} that is installed is another project of that name: {remedy}",
        )
    return str(getattr(imported, "__version__", "")) or _version_of(project), ""


def _check_cores(findings: _Findings) -> tuple[int, int]:
    """Return the number of available cores and of all cores."""
    present = os.cpu_count() or 1
    available = (
        # Schedulers of clusters may restrict a process to some cores.
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else present
    )
    try:
        from joblib import cpu_count

        # Respects the limits of containers.
        granted = int(cpu_count())
    except Exception:  # noqa: BLE001 - reported by _check_libraries
        granted = available
    if granted < available:
        workers = counted(granted, "worker")
        findings.notes.append(
            f"this container may use {granted} of {available} cores: use at most {workers}"
        )
    return min(granted, available), present


def vector_instructions() -> str:
    """Return the widest vector instructions of the processor."""
    if platform.machine().lower() in {"arm64", "aarch64"}:
        return "neon"
    flags = set(processor_entry("flags", "features").lower().split())
    return next((name for flag, name in _VECTOR_FLAGS if flag in flags), "unknown")


def _hdf5_version() -> str:
    import h5py

    return str(h5py.version.hdf5_version)


def _generator() -> str:
    from cnpgen.kernels.machine_code import generator_version, this_processor

    return f"{generator_version()}, for {this_processor().name}"


def _check_handwritten(findings: _Findings) -> tuple[str, str]:
    """Return the origin of handwritten C, and the compiler; note what is slower without both."""
    built = _value_or(_built_variant, "")
    try:
        from cnpgen.kernels.compiler import compiler_version, require_compiler

        path = require_compiler()
        compiler = f"{path}, {compiler_version(path)}"
    except Exception as error:  # noqa: BLE001 - broken libraries raise anything
        compiler = ""
        if not built:
            findings.notes.append(
                f"{error}; without compiled C code planners, the refiner, scenes and observations do not work"
            )
    if built:
        return f"compiled with the package for {built}", compiler
    return ("compiled at its first use" if compiler else "missing"), compiler


def _built_variant() -> str:
    """Return the processor that the package's libraries are compiled for, or an empty text if one is missing."""
    from cnpgen.kernels import c_library
    from cnpgen.kernels.collision import collision_checker
    from cnpgen.kernels.observation import compiled_observations
    from cnpgen.planner import time_parametrization
    from cnpgen.refine.solver import compiled_backend

    libraries = (
        collision_checker.SOURCES,
        compiled_backend.SOURCES,
        [compiled_observations.SOURCE],
        [time_parametrization.SOURCE],
    )
    files = [c_library.find_built((c_library.ARRAYS, *paths)) for paths in libraries]
    return c_library.this_variants()[0].name if all(files) else ""


def _cache_folder() -> str:
    from cnpgen.store.files.cache_folder import default_cache_folder

    return str(default_cache_folder())


def _check_backend(findings: _Findings, cache: str) -> tuple[str, str, bool]:
    """Choose the backend; return it, the reason, and whether the cache is writable."""
    try:
        from cnpgen.kernels.library import choose_backend

        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            backend, folder = choose_backend()
    except Exception as error:  # noqa: BLE001 - broken libraries raise anything
        text = _one_line(error)
        findings.problems += (
            []
            if findings.problems
            else [f"no backend works ({text}): reinstall cnpgen"]
        )
        return "", text, False
    findings.notes += [str(warning.message) for warning in caught]
    if str(folder) != cache:
        # A temporary folder of this check.
        shutil.rmtree(folder, ignore_errors=True)
    reason = (
        "a test kernel was generated and is correct"
        if backend == "compiled"
        else "LLVM does not work"
    )
    return backend, reason, str(folder) == cache


def _check_cache(findings: _Findings, cache: str) -> bool:
    """Return whether cached kernels may be loaded, and note those that may not."""
    from cnpgen.store.files.cache_folder import trust_problem, untrusted_files

    if not cache or not Path(cache).is_dir() or trust_problem(Path(cache)):
        # Noted by the choice of the backend.
        return False
    if files := untrusted_files(Path(cache)):
        findings.notes.append(
            f"cached kernels that other users may have changed are not used ({len(files)}): delete them, the first one"
            f" is {files[0]}"
        )
    return True


def _check_plugins(findings: _Findings) -> Iterator[str]:
    """List the plug-ins of other packages, and note those that nothing uses."""
    found = [entry for entries in entry_points().values() for entry in entries]
    # The groups of add-ons have entries of the project.
    known = {
        *CONTRACTS,
        *(each.group for each in found if each.distribution == PROJECT),
    }
    for entry in found:
        if entry.distribution == PROJECT:
            continue
        yield f"{entry.name} ({entry.group}) of {entry.distribution}"
        if entry.group not in known:
            findings.notes.append(
                f"{entry.name!r} of the package {entry.distribution!r} is ignored: its entry point group"
                f" {entry.group!r} is unknown{nearest(entry.group, known)}"
            )
        elif entry.group in CONTRACTS:
            try:
                load(entry.group, entry.name)
            except RecipeError as error:
                findings.notes += error.errors


def _check_recipes(findings: _Findings) -> str:
    """Load every shipped dataset recipe with its robot."""
    try:
        from cnpgen.make.recipe import load_dataset_recipe
        from cnpgen.problems.load_robot import load_robot
        from cnpgen.schema.catalogue import list_recipes, recipes_root

        names = list(list_recipes("dataset"))
        missing = []
        for name in names:
            try:
                load_robot(load_dataset_recipe(name).pipeline.problem)
            # Robots of optional packages are no defect of the installation.
            except PluginError:
                missing.append(name)
    except Exception as error:  # noqa: BLE001 - broken libraries raise anything
        text = _one_line(error)
        if not findings.problems:
            findings.problems.append(
                f"the shipped recipes cannot be loaded ({text}): reinstall cnpgen"
            )
        return f"cannot be loaded: {text}"
    if not names:
        findings.problems.append(
            f"there are no recipes in {recipes_root()}: reinstall cnpgen"
        )
    more = (
        f", but for those of {', '.join(missing)}: pip install 'cnpgen[robots]'"
        if missing
        else ""
    )
    return f"{len(names)} datasets in {recipes_root()}, their robots load{more}"


def _check_disk(findings: _Findings) -> int:
    try:
        free = shutil.disk_usage(Path.cwd()).free
    except OSError as error:
        findings.notes.append(
            f"the working directory cannot be read ({error.strerror}): change to another one"
        )
        return 0
    if free < MIN_DISK_BYTES:
        findings.notes.append(
            f"only {free / 1e6:,.0f} MB are free in {Path.cwd()}: choose another folder for large datasets"
        )
    return free
