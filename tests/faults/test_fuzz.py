"""A thousandth of what ``python -m tests.faults`` does: changed files of every kind give results or CnpgenErrors."""

import pytest

from tests.faults.fuzz import Outcome, fuzz
from tests.faults.subjects import SUBJECTS

EACH = 12  # inputs of a kind: together some seconds


@pytest.fixture(scope="module")
def outcome() -> Outcome:
    return fuzz(EACH * len(SUBJECTS), seed=2026)


def test_nothing_but_a_result_or_an_error_of_ours(outcome: Outcome) -> None:
    assert outcome.findings == []


@pytest.mark.slow
@pytest.mark.parametrize("kind", SUBJECTS)
def test_files_of_every_kind_were_given(outcome: Outcome, kind: str) -> None:
    assert outcome.read[kind] + outcome.refused[kind] == EACH
    assert outcome.refused[kind]


def test_an_input_is_a_function_of_seed_and_number() -> None:
    first, again = (fuzz(6, seed=3, first=5, kinds=("recipe", "journal")) for _ in range(2))
    assert (first.read, first.refused) == (again.read, again.refused)
