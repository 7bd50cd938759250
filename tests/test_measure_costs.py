"""The list of costly tests: by the mean and the sum of a function, and fixtures count for all of their users."""

from pathlib import Path

import pytest

from tests import measure_costs
from tests.measure_costs import CostMeter, costly, function_of, read_costly


def test_functions_are_judged_by_the_mean_and_the_sum_of_their_parameters() -> None:
    costs = {"a.py::f[1]": 0.01, "a.py::f[2]": 0.05, "a.py::g": 0.2}
    costs |= {f"a.py::many[{k}]": 0.02 for k in range(100)}
    assert costly(costs, 0.1) == {"a.py::g"}
    assert costly(costs, 0.025) == {"a.py::f", "a.py::g"}
    assert costly(costs, 0.1, 1.0) == {"a.py::g", "a.py::many"}


def test_every_listed_function_exists() -> None:
    root, sources = Path(__file__).parents[1], {}
    for name in read_costly():
        file, _, function = name.partition("::")
        sources.setdefault(file, (root / file).read_text(encoding="utf-8"))
        assert f"def {function}(" in sources[file], f"not there any more: {name}"


def test_a_shared_fixture_counts_for_each_of_its_users(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytester.makepyfile(
        test_a="""
        import pytest

        @pytest.fixture(scope="module")
        def shared():
            return sum(range(3_000_000))

        def test_one(shared): pass
        def test_two(shared): pass
        def test_three(): pass
        """
    )
    meter = CostMeter()
    monkeypatch.setattr(CostMeter, "pytest_sessionfinish", lambda _: None)
    pytester.inline_run("-p", "no:cacheprovider", plugins=[meter])
    one, two, three = meter.costs.values()
    assert one > 3 * three
    assert two > 3 * three
    assert {function_of(name) for name in meter.costs} == {
        f"test_a.py::test_{number}" for number in ("one", "two", "three")
    }


def test_with_paths_other_entries_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(measure_costs, "LIST", tmp_path / "costly.txt")
    (tmp_path / "costly.txt").write_text("a.py::old\nb.py::kept\n")
    runs = {
        "not slow and not extended": {"a.py::old": 0.01, "a.py::new": 9.0},
        "quick": {"a.py::old": 0.01},
    }
    monkeypatch.setattr(measure_costs, "measure", lambda tier, _: runs[tier])
    measure_costs.main(["a.py"])
    assert read_costly() == {"a.py::new", "b.py::kept"}
    assert "50% of 2 tests are quick" in capsys.readouterr().out
