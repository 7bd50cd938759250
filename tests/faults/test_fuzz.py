"""A small run of ``python -m tests.faults``: changed files of every kind give results or CnpgenErrors."""

import pytest

from tests.faults.fuzz import Outcome, fuzz
from tests.faults.subjects import SUBJECTS

INPUTS_PER_KIND = 12  # some seconds in total


@pytest.fixture(scope="module")
def outcome() -> Outcome:
    return fuzz(INPUTS_PER_KIND * len(SUBJECTS), seed=2026)


def test_every_input_gives_a_result_or_a_cnpgen_error(outcome: Outcome) -> None:
    assert outcome.findings == []


@pytest.mark.slow
@pytest.mark.parametrize("kind", SUBJECTS)
def test_files_of_every_kind_are_read_or_refused(outcome: Outcome, kind: str) -> None:
    assert outcome.read[kind] + outcome.refused[kind] == INPUTS_PER_KIND
    assert outcome.refused[kind]


def test_an_input_is_a_function_of_seed_and_index() -> None:
    first, again = (
        fuzz(6, seed=3, first=5, kinds=("recipe", "journal")) for _ in range(2)
    )
    assert (first.read, first.refused) == (again.read, again.refused)
