"""Problems and robots that cnpgen ships, loaded on first use: a module of tests loads nothing when it is imported."""

from collections.abc import Callable, Iterator, Mapping
from functools import cache
from typing import Any

from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem


class OnUse(Mapping[str, Any]):
    """Values by name, each made when it is first asked for.

    Args:
        make: Makes the value of a name; called once per name.
        names: Names over which the mapping iterates.
    """

    def __init__(self, make: Callable[[str], Any], *names: str) -> None:
        self._make, self._names = cache(make), names

    def __getitem__(self, name: str) -> Any:
        return self._make(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


PROBLEMS = OnUse(load_problem, "airhockey", "heavy-object")
ROBOTS = OnUse(lambda name: load_robot(PROBLEMS[name]), *PROBLEMS)
