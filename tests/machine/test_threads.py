"""One BLAS thread inside: of whoever calls, however deep and from however many Python threads, and no longer."""

from collections.abc import Callable, Iterator
from threading import Barrier, Thread

import numpy as np
import pytest
import scipy.linalg  # noqa: F401 - its BLAS is to be found
from threadpoolctl import threadpool_info, threadpool_limits

from cnpgen.losses import plan_loss
from cnpgen.losses.plan_loss import PlanLoss
from cnpgen.machine.threads import one_thread
from cnpgen.planner import control_points
from cnpgen.planner import inference_pipeline as inference
from cnpgen.planner.boundary_layer import BoundaryLayer
from cnpgen.planner.planner import Planner
from cnpgen.trajectory.boundary import Boundary
from tests.conftest import HANGING
from tests.examples.models import untrained_model
from tests.examples.shipped import PROBLEMS


@pytest.fixture(autouse=True)
def two_threads() -> Iterator[None]:
    """BLAS has two threads outside, whatever this machine has."""
    with threadpool_limits(2, user_api="blas"):
        yield


def counts() -> set[int]:
    """Return the number of threads of the BLAS libraries."""
    return {
        each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"
    }


def test_there_is_one_thread_inside_and_as_many_as_before_outside() -> None:
    assert counts() == {2}
    with one_thread():
        assert counts() == {1}
        with one_thread():
            assert counts() == {1}
        assert counts() == {1}
    assert counts() == {2}


def test_an_exception_takes_the_limit_back() -> None:
    with pytest.raises(KeyError), one_thread():
        raise KeyError
    assert counts() == {2}


def test_the_last_python_thread_to_leave_takes_the_limit_back() -> None:
    seen: dict[str, set[int]] = {}
    steps = Barrier(2, timeout=HANGING)

    def first() -> None:
        with one_thread():
            steps.wait()  # both are inside
            steps.wait()
        steps.wait()  # this one has left

    def second() -> None:
        with one_thread():
            steps.wait()
            steps.wait()
            steps.wait()
            seen["after the other has left"] = counts()

    threads = [Thread(target=first), Thread(target=second)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert seen == {"after the other has left": {1}}
    assert counts() == {2}


def boundary() -> Boundary:
    rest, q = np.zeros((3, 6)), np.tile(np.linspace(-0.2, 0.3, 6), (3, 1))
    return Boundary(q, rest, rest, q + 0.1, rest)


def loss_call() -> None:
    loss = PlanLoss(PROBLEMS["airhockey"], nodes=8, backend="numpy")
    path, rate = np.zeros((2, 15, 6)), np.ones((2, 20))
    loss(path, rate, weights=loss.weights0, obstacle_poses=np.zeros((2, 4)))


def omega_call() -> None:
    omega = BoundaryLayer(
        PROBLEMS["airhockey"],
        line_projection_steps=0,
        projection_steps=0,
        backend="numpy",
    )
    tasks = omega.tasks(boundary())
    phi, log_rate = np.zeros((3, omega.path_outputs)), np.zeros((3, omega.rate_outputs))
    points = omega(tasks, phi, log_rate)
    omega.vjp(
        tasks, phi, log_rate, path_gradient=points.path, rate_gradient=points.rate
    )


def planner_call() -> None:
    Planner(untrained_model("airhockey", boundary()), backend="numpy").plan_batch(
        boundary()
    )


@pytest.mark.parametrize(
    ("call", "where", "name", "times"),
    [
        (loss_call, plan_loss, "basis_table", 1),
        (omega_call, control_points, "control_points", 2),
        (omega_call, control_points, "vjp", 1),
        (planner_call, inference, "ends_of", 1),
    ],
)
def test_loss_omega_and_planner_compute_with_one_thread(
    call: Callable[[], None],
    where: object,
    name: str,
    times: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found: list[set[int]] = []
    inner = getattr(where, name)

    def seen(*arguments: object, **options: object) -> object:
        found.append(counts())
        return inner(*arguments, **options)

    monkeypatch.setattr(where, name, seen)
    call()
    assert found == [{1}] * times
    assert counts() == {2}
