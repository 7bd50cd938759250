"""CasADi's solvers on the refiner's transcription: as good as the own one, and interruptible."""

import numpy as np
import pytest
from example_plans import load
from test_refine import refiner, task

from cnpgen.refine.alternatives import minimise_with
from cnpgen.refine.sqp import Settings


def test_sqpmethod_finds_what_the_own_solver_finds() -> None:
    asked, tool = task(load("hit")), refiner("airhockey")
    which = tool.passes.first
    own = tool.minimise(asked, which, tool._straight(asked))
    motion, bounds = tool.transcription(asked, which), tool._bounds[which].of(asked.start_xyz)
    other = minimise_with(motion, bounds, tool._straight(asked), Settings(), solver="sqpmethod")
    assert other.violation < 1e-3
    assert other.cost == pytest.approx(own.cost, rel=5e-3)
    assert other.iterations > 1


@pytest.mark.parametrize("solver", ["ipopt", "sqpmethod"])
def test_an_interruption_inside_a_plug_in_is_not_lost(solver: str, monkeypatch: pytest.MonkeyPatch) -> None:
    asked, tool = task(load("hit")), refiner("airhockey")
    motion, which = tool.transcription(asked, tool.passes.first), tool.passes.first
    evaluate, calls = motion.evaluate, []

    def interrupt(x: np.ndarray) -> object:
        calls.append(x)
        if len(calls) > 3:
            raise KeyboardInterrupt
        return evaluate(x)

    monkeypatch.setattr(motion, "evaluate", interrupt)
    with pytest.raises(KeyboardInterrupt):
        minimise_with(motion, tool._bounds[which].of(asked.start_xyz), tool._straight(asked), Settings(), solver=solver)


def test_without_iterations_the_first_variables_come_back() -> None:
    asked, tool = task(load("hit")), refiner("airhockey")
    which, x = tool.passes.first, tool._straight(asked)
    bounds = tool._bounds[which].of(asked.start_xyz)
    result = minimise_with(tool.transcription(asked, which), bounds, x, Settings(max_iterations=0), solver="sqpmethod")
    np.testing.assert_array_equal(result.x, x)
