"""Arguments that raised exceptions of Python or NumPy: each is a UsageError that names the argument."""

import re
import tempfile
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import cnpgen
from cnpgen.addons.trajectories.fit import fit_motion
from cnpgen.errors import RecipeError, UsageError
from cnpgen.losses.metric import Metric
from cnpgen.problems.obstacles import with_capacity
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import (
    ProblemRecord,
    open_problem,
    record_problem,
)
from cnpgen.problems.scenes.scene_problem import make_mesh
from cnpgen.schema.arguments import check_range, distinct
from cnpgen.trajectory.spline_motion import Motion
from cnpgen.trajectory.trajectory_spec import TrajectorySpec


def capacity(numbers: Any) -> Any:
    """Reserve obstacles in a problem of a robot with link geometry."""
    return with_capacity(load_problem("heavy-object"), numbers)


CALLS: dict[str, tuple[Callable[[], Any], str]] = {
    "a long name": (lambda: cnpgen.load_dataset("a" * 100_000), "cannot be a path"),
    "NUL in a name": (lambda: cnpgen.load_dataset("a\0b"), "folder must name a folder"),
    "short times": (
        lambda: fit_motion([0, 1e-320, 2e-320], np.zeros((3, 2)), spec=TrajectorySpec()),
        "t must last at least 1e-09 s, got",
    ),
    "texts": (lambda: Motion(np.full((1, 9, 2), "a"), np.ones((1, 9))), "path must be"),
    "objects": (lambda: Motion(np.ones((1, 9, 2)), np.full((1, 9), {})), "rate must be"),
    "a list as a problem": (lambda: ProblemRecord([], ""), "recipe must be a text"),
    "a problem without a robot": (lambda: ProblemRecord("{}", {}), "urdf must be a"),
    "a name as a record": (lambda: open_problem("airhockey"), "must be a ProblemRecord"),
    "unhashable": (lambda: open_problem([]), "record must be a ProblemRecord, got"),
    "negative capacity": (lambda: capacity({"box": -1}), "from 0 to 10000, got -1"),
    "huge capacity": (lambda: capacity({"box": 10**15}), "capacity must be an integer"),
    "kinds": (lambda: capacity({(1,): 2}), "capacity must be a mapping of kinds"),
    "weights": (lambda: Metric([object()], [1.0]), "weights must be"),
    "budgets": (lambda: Metric([1.0], {"a": [1]}), "budgets must be"),
    "a number": (lambda: make_mesh("box", points=-1), "points must have shape"),
}  # fmt: skip


@pytest.mark.parametrize("name", CALLS)
def test_an_argument_is_refused_by_its_name(name: str) -> None:
    call, message = CALLS[name]
    with pytest.raises(UsageError, match=message) as caught:
        call()
    assert "\0" not in str(caught.value)
    assert len(str(caught.value)) < 1000


def test_ranges_print_as_numbers_that_differ() -> None:
    low = -0.05
    with pytest.raises(UsageError) as caught:
        check_range("angle", np.nextafter(low, -1), low, 0.1, "rad")
    assert "must be from -0.05" in str(caught.value)
    assert "got -0.05000000000000001 rad" in str(caught.value)
    assert distinct(0.1, 0.1) == ("0.1", "0.1")
    assert distinct(1 / 3, 0.25) == ("0.333333", "0.25")
    near = np.nextafter(0.25, 1)
    assert len(set(distinct(0.25, near, 0.25))) == 2
    assert distinct(np.nan, 1.0, np.nan) == ("nan", "1", "nan")


def test_errors_of_stored_problems_name_no_temporary_folder() -> None:
    record = record_problem(load_problem("airhockey"))
    limit = re.compile(r'lower="[^"]*" upper="[^"]*"')
    changes = {
        "robot.urdf: joint_1: the lower position limit must be below": limit.sub(
            'lower="1" upper="1"', record.urdf
        ),
        "must be a number": record.urdf.replace('<mass value="', '<mass value="x'),
        "has no joint 'joint_3'": record.urdf.replace('joint_3"', 'joint_33"'),
    }
    for message, urdf in changes.items():
        with pytest.raises(RecipeError, match=message) as caught:
            open_problem(ProblemRecord(record.recipe, urdf))
        assert tempfile.gettempdir() not in str(caught.value)
