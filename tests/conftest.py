"""Shared parts of tests: one BLAS thread, prepared pipelines, candidate batches, one small dataset per recipe."""

# ruff: noqa: E402 - the environment comes first
import os

for _variable in (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
):
    os.environ[_variable] = (
        "1"  # before NumPy is imported: its result must not depend on the machine's load
    )
os.environ["LOKY_MAX_CPU_COUNT"] = (
    "1"  # the tests run side by side already: workers only where a test requests them
)
os.environ.pop(
    "PYTHONDONTWRITEBYTECODE", None
)  # hundreds of processes would compile the whole package each

import ctypes
import shutil
import signal
import sys

# Without cached byte code, pytest rewrites every assert of the suite in every run.
sys.dont_write_bytecode = False

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from syrupy.assertion import SnapshotAssertion

from cnpgen.kernels.c_library import ARRAYS, find_built
from cnpgen.kernels.collision.collision_checker import SOURCES
from cnpgen.kernels.compiler import find_compiler
from cnpgen.kernels.library import Backend, KernelLibrary, default_cache_folder
from cnpgen.make.make_dataset import make_dataset
from cnpgen.make.recipe import DatasetRecipe, load_dataset_recipe
from cnpgen.pipelines.pipeline import Pipeline, load_pipeline
from cnpgen.pipelines.prepared import PreparedPipeline, random_generator
from cnpgen.pipelines.stages.stage import CandidateBatch
from cnpgen.robots.robot import Robot
from cnpgen.schema import entry_points
from cnpgen.store.files.cache_folder import exclusive_lock, make_private_folder
from cnpgen.store.layout import MANIFEST
from tests import refusals
from tests.examples.casadi_kernels import CasadiLibrary
from tests.measure_costs import function_of, read_costly

SHIPPED = ("airhockey-hit", "airhockey-replan", "heavy-object")
TINY_ROWS = 660  # 600 + 60: three shards of training and one of validation
TINY_SHARD = 250
CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH, CAPABILITY_VERSION = (
    1,
    2,
    0x20080522,
)  # of Linux: capabilities(7)
HANGING = 1800  # [s] a longer run hangs on any machine


def some(values: Iterable[Any], kept: int = 1, mark: str = "extended") -> list[Any]:
    """Parameters: the first few in every run, the others, which repeat the claim, in the slow or the extended run."""
    return [
        value if at < kept else _marked(value, mark) for at, value in enumerate(values)
    ]


def _marked(value: Any, mark: str) -> Any:
    chosen = getattr(pytest.mark, mark)
    if isinstance(value, type(pytest.param())):
        return pytest.param(*value.values, marks=(*value.marks, chosen), id=value.id)
    return pytest.param(
        *(value if isinstance(value, tuple) else (value,)), marks=chosen
    )


needs_compiler = pytest.mark.skipif(
    find_compiler() is None, reason="no C compiler on this machine"
)
needs_compiled_code = pytest.mark.skipif(
    find_compiler() is None and not find_built((ARRAYS, *SOURCES)),
    reason="neither compiled C code of the package nor a C compiler",
)

pytest_plugins = ["pytester"]

Prepare = Callable[..., PreparedPipeline]


def _ignore_installed_plugins() -> None:
    """Read the entry points of cnpgen and of packages that a test installs, not of others on this machine."""
    find = entry_points._metadata_files
    foreign = {file for file in find() if not file.parent.name.startswith("cnpgen-")}
    entry_points._metadata_files = lambda: (
        file for file in find() if file not in foreign
    )
    entry_points.entry_points.cache_clear()


def pytest_configure(config: pytest.Config) -> None:
    """Let the tests run where there is no compiler, every dataset then after a warning, and in the background."""
    _ignore_installed_plugins()
    if (
        signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    ):  # as shells start what runs in the background
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark every test as quick that is in no other tier and not in the list of ``tests.measure_costs``."""
    costly = read_costly()
    for item in items:
        in_a_tier = any(item.get_closest_marker(tier) for tier in ("slow", "extended"))
        if not in_a_tier and function_of(item.nodeid) not in costly:
            item.add_marker(pytest.mark.quick)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Choose one process more than there are processors: a quarter of the time is waiting for other processes."""
    return (os.cpu_count() or 1) + 1


@pytest.fixture
def file_permissions() -> Iterator[None]:
    """Let the kernel check the permissions of files, also for root; the test may leave folders that are read-only."""
    if os.geteuid() != 0:
        yield
        return
    if not sys.platform.startswith("linux"):
        pytest.skip("root may read and write everything here")
    header, sets = (ctypes.c_uint32 * 2)(CAPABILITY_VERSION, 0), (ctypes.c_uint32 * 6)()
    library = ctypes.CDLL(None, use_errno=True)
    assert library.capget(header, sets) == 0
    effective = sets[0]
    sets[0] &= ~(1 << CAP_DAC_OVERRIDE | 1 << CAP_DAC_READ_SEARCH)
    assert library.capset(header, sets) == 0
    yield
    sets[0] = effective
    assert library.capset(header, sets) == 0


@pytest.fixture(scope="session")
def fastest() -> Backend:
    """The fastest backend."""
    return "compiled"


@pytest.fixture(scope="session")
def cache_folder() -> Path:
    """The user's own kernel cache: kernels are compiled once per version of the package, not per run of the tests."""
    return default_cache_folder()


@pytest.fixture(scope="session")
def prepare(fastest: Backend, cache_folder: Path) -> Prepare:
    """Prepare a pipeline, given by name or as a recipe, once per session."""

    @cache
    def by_name(name: str, backend: Backend, dtype: str) -> PreparedPipeline:
        return PreparedPipeline(
            load_pipeline(name), backend=backend, cache_folder=cache_folder, dtype=dtype
        )

    def prepared(
        what: str | Pipeline, backend: Backend | None = None, dtype: str = "float64"
    ) -> PreparedPipeline:
        if isinstance(what, str):
            return by_name(what, backend or fastest, dtype)
        return PreparedPipeline(
            what, backend=backend or fastest, cache_folder=cache_folder, dtype=dtype
        )

    return prepared


@pytest.fixture(scope="session")
def kernels_of(cache_folder: Path) -> Callable[..., KernelLibrary]:
    """Give the kernel library of a prepared pipeline's problem, for any backend and CasADi."""

    def library(prepared: PreparedPipeline, backend: str) -> KernelLibrary:
        kernels = prepared.context.kernels
        if backend == "casadi":
            return CasadiLibrary(**vars(kernels))
        return replace(kernels, backend=backend)

    return library


def run_stages(
    prepared: PreparedPipeline, size: int, *, seed: int = 0, until: str = ""
) -> CandidateBatch:
    """Run one round of draws through the stages, up to and including the first one of class ``until``."""
    draws, random = CandidateBatch(size), random_generator(seed, "train", 0)
    for stage in prepared.pipeline.stage:
        stage.prepare(prepared.context)(draws, random)
        if type(stage).__name__ == until:
            break
    return draws


class Arm:
    """A robot as Pinocchio sees it, one state at a time: the reference of the stages' tests.

    Args:
        robot: The robot; its reduced Pinocchio model is used and nothing else of it.
    """

    def __init__(self, robot: Robot) -> None:
        import pinocchio as pin

        self.pin, self.model, self.data = pin, robot.model, robot.model.createData()
        self.tip, self.frame = (
            robot.model.getFrameId(robot.tip),
            pin.ReferenceFrame.LOCAL_WORLD_ALIGNED,
        )

    def pose(self, q: np.ndarray) -> Any:
        """Placement of the tip in the world."""
        self.pin.framesForwardKinematics(self.model, self.data, q)
        return self.data.oMf[self.tip]

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """Jacobian of the tip in world axes, linear rows first, shape (6, n)."""
        return np.array(
            self.pin.computeFrameJacobian(
                self.model, self.data, q, self.tip, self.frame
            )
        )

    def velocity(self, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """Velocity of the tip [m/s]."""
        self.pin.forwardKinematics(self.model, self.data, q, dq)
        return np.array(
            self.pin.getFrameVelocity(
                self.model, self.data, self.tip, self.frame
            ).linear
        )

    def acceleration(
        self, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray
    ) -> np.ndarray:
        """Acceleration of the tip [m/s^2]."""
        self.pin.forwardKinematics(self.model, self.data, q, dq, ddq)
        return np.array(
            self.pin.getFrameClassicalAcceleration(
                self.model, self.data, self.tip, self.frame
            ).linear
        )

    def torque(self, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
        """Inverse dynamics [N m]."""
        return np.array(self.pin.rnea(self.model, self.data, q, dq, ddq))


def without_stages(pipeline: Pipeline, *kinds: str) -> Pipeline:
    """Return the pipeline without its stages of some classes."""
    return replace(
        pipeline,
        stage=tuple(
            stage for stage in pipeline.stage if type(stage).__name__ not in kinds
        ),
    )


def tiny_recipe(name: str, **changes: Any) -> DatasetRecipe:
    """A shipped recipe with few rows: 600 of training, 60 of validation."""
    return replace(
        load_dataset_recipe(name), splits={"train": 600, "validation": 60}, **changes
    )


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Make a small dataset of a shipped recipe, once for all processes that the tests run in; not to be changed."""
    own = tmp_path_factory.getbasetemp()
    shared = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "tiny"
    make_private_folder(shared)

    @cache
    def made(name: str) -> Path:
        folder = shared / name
        with exclusive_lock(shared / f"{name}.lock"):
            if not (folder / MANIFEST).exists():
                make_dataset(
                    tiny_recipe(name), folder, shard_size=TINY_SHARD, workers=1
                )
        return folder

    return made


@pytest.fixture
def damaged(tiny: Callable[[str], Path], tmp_path: Path) -> Path:
    """A copy of a small dataset, to be damaged."""
    return Path(shutil.copytree(tiny("airhockey-hit"), tmp_path / "airhockey-hit"))


def columns_of(folder: Path, split: str = "train") -> dict[str, np.ndarray]:
    """Read all rows of a split."""
    from cnpgen.store.reader import open_dataset

    return open_dataset(folder, allow_incomplete=True).read(split)


@pytest.fixture
def fresh_compiler() -> Iterator[None]:
    """Forget which compiler was found, before and after the test."""
    from cnpgen.kernels import c_library, compiler

    def forget() -> None:
        compiler.find_compiler.cache_clear()
        compiler.compiler_version.cache_clear()
        c_library.load_library.cache_clear()

    forget()
    yield
    forget()


@pytest.fixture(autouse=True)
def _wording(
    snapshot: SnapshotAssertion, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Give ``is_refused`` the snapshots of the running test."""
    refusals.RunningTest.texts = snapshot.use_extension(refusals.Wording)
    base = tmp_path_factory.getbasetemp()
    is_worker = base.name.startswith("popen-gw")
    refusals.RunningTest.base = base.parent if is_worker else base
