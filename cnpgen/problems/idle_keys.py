"""Keys of a problem that limit no motion, since no constraint of the problem reads them."""

from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

from cnpgen.documents import Names
from cnpgen.problems.problem import Problem
from cnpgen.schema import registry
from cnpgen.schema.keys import keys

# Key, and whether it is stated -> further keys that are read then.
_FURTHER_KEYS = {
    ("limits.acceleration", False): ("limits.velocity", "limits.velocity_scale"),
    ("limits.jerk", False): (
        "limits.acceleration",
        "limits.acceleration_rate",
        "limits.acceleration_cap",
    ),
    ("payload.touch_links", True): ("payload.size",),
}


def idle_keys(problem: Problem) -> dict[str, str]:
    """Return the stated keys of a problem that limit no motion: key -> what they need.

    The objective and the stages of pipelines may use them.
    """
    reads = [constraint.reads for constraint in problem.constraint]
    # A constraint of a plug-in that declares no keys may read any.
    if None in reads:
        return {}
    used = {key for each in reads for key in _with_further_keys(problem, each or ())}
    kinds = {key: kind for key, kind in _readers().items() if key not in used}
    needs = problem.drive.idle_keys | {
        key: f"constraint {kind!r}" for key, kind in kinds.items()
    }
    # A factor of an inertia of zero.
    if problem.payload is not None and not problem.payload.inertia_matrix.any():
        needs.setdefault("parameters.payload_inertia", "inertia of the payload")
    return {key: need for key, need in needs.items() if _is_stated(problem, key)}


def idle_text(idle: Mapping[str, str]) -> str:
    """Return one line, "limits no motion: limits.jerk (no constraint 'joint-jerk')"; empty if there are none."""
    by_need: dict[str, list[str]] = {}
    for key, need in idle.items():
        by_need.setdefault(need, []).append(key)
    texts = [f"{', '.join(names)} (no {need})" for need, names in by_need.items()]
    return f"limits no motion: {'; '.join(texts)}" if texts else ""


def _is_stated(problem: Problem, key: str) -> bool:
    """Return whether the value of a key, such as "limits.jerk", differs from its default."""
    owner: Any = problem
    *tables, name = key.split(".")
    for table in tables:
        owner = getattr(owner, table, None)
    defaults = {each.name: each.default for each in keys(type(owner))} if owner else {}
    return name in defaults and bool(getattr(owner, name) != defaults[name])


@cache
def _readers() -> dict[str, str]:
    """Return the first kind of constraint that reads each key: key -> kind."""
    found: dict[str, str] = {}
    for kind in registry.BUILT_IN[registry.CONSTRAINTS]:
        for key in registry.load(registry.CONSTRAINTS, kind).reads or ():
            found.setdefault(key, kind)
    return found


def _with_further_keys(problem: Problem, names: Names) -> Iterator[str]:
    """Yield keys, and those that are read because these are stated, or are not."""
    for name in names:
        yield name
        further = _FURTHER_KEYS.get((name, _is_stated(problem, name)), ())
        yield from _with_further_keys(problem, further)
