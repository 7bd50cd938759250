"""A closer look at smooth conditions: at maxima between samples that could decide, until nothing is left to gain.

A condition of torques, tilt or the tip's place has no polynomial to prove it by. Between samples it is smooth: near a
maximum it is a parabola, whose height above the largest sample is known from three of them. Where four times that
height could matter, samples are added at the parabola's vertex and in the middle of both sides, again and again.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cnpgen.judges.plans.closer import is_contact
from cnpgen.judges.plans.measure import Measured
from cnpgen.judges.plans.survey import Survey
from cnpgen.judges.plans.verdict import Margin

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

CAUTION = 4.0  # times the parabola's height: third derivatives are not looked at
CLOSE = 1e-7  # of what is allowed: less is not looked for where it decides whether more is exceeded than that
ROUGH = 1e-2  # the same elsewhere
ROUNDS = 24  # at most; a smooth maximum takes three, a kink one per halving
MOST = 64  # maxima of all conditions that are looked into


@dataclass(frozen=True)
class _Brackets:
    """B maxima, each with a neighbour on either side.

    Attributes:
        of: Index of the measured condition, shape (B,).
        part: Which of its values, shape (B,).
        s: Phases, ascending, shape (B, 3).
        share: Excess there in multiples of what is allowed, shape (B, 3); the middle one is the largest.
    """

    of: Indices
    part: Indices
    s: Array
    share: Array

    def __getitem__(self, which: NDArray[np.bool_] | Indices) -> "_Brackets":
        return _Brackets(self.of[which], self.part[which], self.s[which], self.share[which])

    @cached_property
    def tops(self) -> tuple[Array, Array]:
        """The phases of the parabolas' vertices and how high these are above the middle samples, shape (B,) each."""
        (a, b, c), (fa, fb, fc) = self.s.T, self.share.T
        with np.errstate(divide="ignore", invalid="ignore"):
            left, right = (fb - fa) / (b - a), (fb - fc) / (c - b)  # slopes down to both sides, not negative
            bend = (left + right) / (c - a)
            away = (left * (c - b) - right * (b - a)) / (2 * (left + right))
            height = bend * away**2
        good = np.isfinite(away) & np.isfinite(height)
        return np.where(good, np.clip(b + np.where(good, away, 0.0), a, c), b), np.where(good, height, 0.0)


def look_at_peaks(survey: Survey) -> Iterator[tuple[Measured, Margin]]:
    """Yield conditions that are no contacts, and their margins around maxima that could decide.

    Args:
        survey: A motion; its world is moved.
    """
    smooth = [each for each in survey.measured if not is_contact(each.constraint)]
    brackets = _promising(_maxima(survey.samples.s, smooth), smooth)
    for _ in range(ROUNDS):
        if not len(brackets.of):
            break
        s = np.unique(_new_phases(brackets))
        survey.move(s)
        closer = {k: _again(survey, smooth[k], s) for k in set(brackets.of.tolist())}
        for k, found in closer.items():
            yield smooth[k], survey.margin(found, s)
        brackets = _worth(_narrowed(brackets, s, closer))


def _again(survey: Survey, each: Measured, s: Array) -> Measured:
    """Measure a condition at other phases."""
    found = survey.measure(each.constraint, s)
    return next(other for other in found if other.condition.name == each.condition.name)


def _maxima(s: Array, measured: Sequence[Measured]) -> _Brackets:
    """Find the samples that are larger than their neighbours."""
    of, part, at = [], [], []
    for index, each in enumerate(measured):
        share = each.share
        rows, k = np.nonzero((share[:, 1:-1] >= share[:, :-2]) & (share[:, 1:-1] >= share[:, 2:]))
        of.append(np.full(len(k), index))
        part.append(rows)
        at.append(k + 1)
    which, rows, k = (np.concatenate([np.zeros(0, np.intp), *parts]) for parts in (of, part, at))
    around = k[:, None] + np.array([-1, 0, 1])
    shares = np.array([measured[i].share[row, near] for i, row, near in zip(which, rows, around, strict=True)])
    return _Brackets(which, rows, s[around], shares.reshape(-1, 3))


def _promising(brackets: _Brackets, measured: Sequence[Measured]) -> _Brackets:
    """Keep maxima that could be the largest of their condition, where that could be beyond its bound."""
    largest = np.array([np.max(each.share, initial=-np.inf) for each in measured])
    hope = brackets.share[:, 1] + CAUTION * brackets.tops[1]
    worth = (hope >= largest[brackets.of]) & (hope > 0) if len(largest) else np.zeros(0, bool)
    kept = brackets[worth]
    return _worth(kept[np.argsort(-hope[worth], kind="stable")[:MOST]])


def _worth(brackets: _Brackets) -> _Brackets:
    """Keep those between whose samples something is left to gain."""
    top, gain = brackets.share[:, 1], CAUTION * brackets.tops[1]
    return brackets[gain > np.where((top <= 1) & (top + gain > 1), CLOSE, ROUGH)]


def _new_phases(brackets: _Brackets) -> Array:
    """Return three phases inside every bracket: the vertex and the middles of both sides, shape (B, 3)."""
    vertex, _ = brackets.tops
    middles = (brackets.s[:, 1:] + brackets.s[:, :-1]) / 2
    return np.column_stack([vertex, middles])


def _narrowed(brackets: _Brackets, s: Array, closer: Mapping[int, Measured]) -> _Brackets:
    """Put the new samples into the brackets and keep the largest with its neighbours."""
    k = np.searchsorted(s, _new_phases(brackets))
    shares = {index: each.share for index, each in closer.items()}
    new = np.array([shares[i][row, at] for i, row, at in zip(brackets.of, brackets.part, k, strict=True)])
    phases, values = np.hstack([brackets.s, s[k]]), np.hstack([brackets.share, new])
    order = np.argsort(phases, axis=1, kind="stable")
    phases, values = (np.take_along_axis(each, order, axis=1) for each in (phases, values))
    top = np.clip(np.argmax(values, axis=1), 1, phases.shape[1] - 2)[:, None] + np.array([-1, 0, 1])
    return _Brackets(
        brackets.of, brackets.part, np.take_along_axis(phases, top, axis=1), np.take_along_axis(values, top, axis=1)
    )
