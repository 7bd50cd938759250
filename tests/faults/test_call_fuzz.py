"""A small run of ``python -m tests.faults --calls``: wrong arguments give results or errors that name the argument."""

import inspect
from contextlib import suppress
from typing import Any
from unittest.mock import ANY

import numpy as np
import pytest

import cnpgen
from cnpgen import benchmark, losses, recipes, scenes, trajectories
from cnpgen.errors import MachineError, UsageError
from cnpgen.schema import arguments
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import integer, numbers
from tests.faults.call_fuzz import CallOutcome, fuzz_calls
from tests.faults.valid_calls import EXCLUDED, ValidCall, valid_calls
from tests.refusals import is_refused

CALLS = 2500  # some seconds
PUBLIC_MODULES = (cnpgen, losses, benchmark, recipes, scenes, trajectories)


@pytest.fixture(scope="module")
def valid(tmp_path_factory: pytest.TempPathFactory) -> list[ValidCall]:
    return valid_calls(tmp_path_factory.mktemp("calls"))


def test_every_wrong_call_gives_a_result_or_an_error_with_the_name_of_an_argument() -> (
    None
):
    outcome = fuzz_calls(CALLS, seed=2026)
    assert outcome.findings == []
    assert outcome.returned + outcome.refused == CALLS
    assert outcome.refused > outcome.returned


def test_every_valid_call_succeeds(valid: list[ValidCall]) -> None:
    for call in valid:
        with suppress(MachineError):  # of an optional package that is not installed
            call()


def test_every_public_callable_has_a_valid_call(valid: list[ValidCall]) -> None:
    names = {call.name for call in valid}
    public = {
        name: getattr(module, name)
        for module in PUBLIC_MODULES
        for name in module.__all__
    }
    missing = [
        name
        for name, value in public.items()
        if callable(value)
        and name not in names | set(EXCLUDED)
        and not _is_table(value)
    ]
    assert missing == []
    functions = {
        f"{name}.{method}"
        for name, value in public.items()
        for method in _methods(value)
    }
    excluded = tuple(
        f"{name}."
        for name in (*EXCLUDED, "Executed", "Simulation")
        if name not in {"Dataset", "Benchmark"}
    )
    assert [
        name
        for name in functions - names
        if not name.startswith((*excluded, "Model.", "Dataset.scenes"))
    ] == []


def _is_table(value: Any) -> bool:
    """Return whether a class is a table of recipes: its fields are checked when a file is read, not when it is made."""
    return inspect.isclass(value) and value.__module__.startswith(
        (
            "cnpgen.robots",
            "cnpgen.trajectory",
            "cnpgen.problems",
            "cnpgen.addons.trajectories.sampled_trajectory",
        )
    )


def _methods(value: Any) -> list[str]:
    if not inspect.isclass(value) or _is_table(value):
        return []
    return [
        name
        for name, member in vars(value).items()
        if inspect.isfunction(member) and not name.startswith("_")
    ]


def test_wrong_types_are_found_before_the_call_or_from_its_exception() -> None:
    @checked_arguments
    def half(
        n: int, *, scale: float = 1.0, whole: bool = False, text: str | None = None
    ) -> float:
        return scale * n / 2 if not whole else n // 2

    assert half(np.int32(3), scale=np.float32(0.5)) == 0.75
    assert half(5, whole=np.True_, text=None) == 2
    for wrong in ({"n": "3"}, {"scale": [1.0]}, {"whole": 1}, {"text": 3}):
        with is_refused(UsageError, argument=ANY) as caught:
            half(**{"n": 3, **wrong})
        assert caught.value.argument == next(iter(wrong))
    with pytest.raises(
        ZeroDivisionError
    ):  # all types are right: the error is not the caller's
        checked_arguments(lambda n: 1 / n)(0)


def test_masked_arrays_are_refused() -> None:
    masked = np.ma.masked_invalid([0.1, np.nan])
    for values in (masked, [masked, masked]):
        with is_refused(UsageError, argument="q"):
            numbers("q", values)


def test_requests_that_exceed_the_memory_are_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for argument, call in (
        ("n", lambda: cnpgen.draw_boundary_problems("airhockey-hit", 10**15)),
        ("nodes", lambda: cnpgen.PlanLoss("airhockey", nodes=10**15)),
    ):
        with pytest.raises(UsageError, match=f"^{argument} must be smaller: 1,000,000"):
            call()
    monkeypatch.setattr(arguments, "MIN_CHECKED_SIZE", 1000)
    monkeypatch.setattr(arguments, "available_bytes", lambda: 10**6)
    with is_refused(UsageError, argument="n"):
        cnpgen.draw_boundary_problems("airhockey-hit", 100_000)


def test_an_error_of_a_whole_sentence_keeps_its_text_and_carries_the_argument() -> None:
    error = UsageError("there is no plan 3", concerns="which")
    assert (str(error), error.argument) == ("there is no plan 3", "which")
    assert UsageError("choose another {out}", remedies={"out": None}).argument == "out"
    with is_refused(UsageError, argument="n"):
        integer("n", "3")


def test_calls_are_a_function_of_the_seed() -> None:
    def counts(outcome: CallOutcome) -> tuple[int, int, dict[str, int]]:
        return outcome.returned, outcome.refused, dict(outcome.functions)

    assert counts(fuzz_calls(15, seed=4)) == counts(fuzz_calls(15, seed=4))
