"""Parameters of a problem: quantities of its manifold, limits and load that differ from sample to sample."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.schema.arguments import distinct
from cnpgen.schema.keys import Range, field, keys

TABLE_PARAMETERS = ("table_height", "table_roll", "table_pitch")
TABLE_BOUNDS = ("table_x_low", "table_x_high", "table_y_low", "table_y_high")
UPRIGHT_TURN = ("upright_roll", "upright_pitch")
UPRIGHT_TOLERANCE = "upright_tolerance"
PAYLOAD_CENTRE = ("payload_x", "payload_y", "payload_z")
PAYLOAD_PARAMETERS = ("payload_mass", *PAYLOAD_CENTRE, "payload_inertia")
MAX_TILT_RAD = 0.5  # of a table or an upright direction about each axis
RANGE_ROUNDING = 1e-12  # of values at the ends of a range
# Argument of the readers of files and tasks.
EXTRAPOLATE: Mapping[str, object] = {"extrapolate": True}


def optional_key(doc: str, unit: str = "1", default: Any = None, **bounds: Any) -> Any:
    """Declare a key that may be absent and exists since version 2 of the recipe schema; see ``field``."""
    return field(doc, unit=unit, default=default, since_version=2, **bounds)


def _tilt(doc: str) -> Any:
    """Declare the optional range of an angle of a tilt."""
    return optional_key(doc, "rad", low=-MAX_TILT_RAD, high=MAX_TILT_RAD)


def _has_any(names: Sequence[str], doc: str) -> cached_property[bool]:
    """Declare a property that is true if one of some parameters differs from sample to sample."""
    declared = cached_property[bool](
        lambda ranges: any(name in names for name in ranges.names)
    )
    declared.__doc__ = doc
    return declared


@dataclass(frozen=True, kw_only=True)
class ParameterRanges:
    """Ranges of the parameters that samples of a problem have, in the order of their columns."""

    table_height: Range | None = optional_key(
        "height of the table above that of the constraint 'table'", "m"
    )
    table_roll: Range | None = _tilt("turn of the table about its x axis")
    table_pitch: Range | None = _tilt("turn of the table about world y, after the roll")
    table_x_low: Range | None = optional_key(
        "lower bound of the table's rectangle along its x axis", "m"
    )
    table_x_high: Range | None = optional_key("upper bound along x", "m")
    table_y_low: Range | None = optional_key("lower bound along y", "m")
    table_y_high: Range | None = optional_key("upper bound along y", "m")
    upright_roll: Range | None = _tilt(
        "turn about world x of the direction of the constraint 'vertical' or 'axis'"
    )
    upright_pitch: Range | None = _tilt("its turn about world y, after the roll")
    upright_tolerance: Range | None = optional_key(
        "'angle' of the constraint 'axis', or 'tolerance' of an aligned axis and of 'vertical'",
        "rad",
        low=1e-4,
        high=1.5,
    )
    velocity_factor: Range | None = optional_key(
        "joint velocity limit, as a fraction of that of [limits]", low=1e-3, high=1.0
    )
    acceleration_factor: Range | None = optional_key(
        "joint acceleration limit, as a fraction of that of [limits]",
        low=1e-3,
        high=1.0,
    )
    payload_mass: Range | None = optional_key(
        "mass of the payload, whose inertia is proportional to it", "kg", low=1e-9
    )
    payload_x: Range | None = optional_key(
        "centre of mass of the payload along the tip's x axis", "m", plausible=5.0
    )
    payload_y: Range | None = optional_key(
        "the same along its y axis", "m", plausible=5.0
    )
    payload_z: Range | None = optional_key(
        "the same along its z axis", "m", plausible=5.0
    )
    payload_inertia: Range | None = optional_key(
        "inertia of the payload about its centre, as a fraction of that of [payload] at equal mass",
        low=0.0,
    )

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters that samples have."""
        return tuple(
            key.name for key in keys(type(self)) if getattr(self, key.name) is not None
        )

    @property
    def units(self) -> str:
        """Unit of all values, or one per value, separated by commas, if they differ."""
        units = self.value_units
        return units[0] if len(set(units)) == 1 else ", ".join(units)

    @property
    def value_units(self) -> tuple[str, ...]:
        """Unit of every value."""
        return tuple(key.unit for key in keys(type(self)) if key.name in self.names)

    @property
    def ranges(self) -> tuple[Range, ...]:
        """Ranges of the parameters that samples have."""
        return tuple(getattr(self, name) for name in self.names)

    tilts_table = _has_any(TABLE_PARAMETERS, "Whether the table is raised or tilted.")
    changes_rectangle = _has_any(
        TABLE_BOUNDS,
        "Whether the rectangle of the table differs from sample to sample.",
    )
    turns_upright = _has_any(
        UPRIGHT_TURN, "Whether the direction of ``vertical`` or ``axis`` differs."
    )
    changes_payload = _has_any(
        PAYLOAD_PARAMETERS, "Whether the payload differs from sample to sample."
    )

    def __len__(self) -> int:
        return len(self.names)

    def nominal(self, values: Mapping[str, float]) -> Array:
        """Return the parameters of a sample that gives none, shape (width,).

        ``values`` are those of the problem.
        """
        factors = ("velocity_factor", "acceleration_factor", "payload_inertia")
        # Summands are 0 and factors 1, unless the problem gives a value.
        nominal = (
            dict.fromkeys(self.names, 0.0) | dict.fromkeys(factors, 1.0) | dict(values)
        )
        return np.array([nominal[name] for name in self.names], np.float64)

    def split(
        self, values: Sequence[Any] | Array, nominal: Array
    ) -> tuple[Any, dict[str, Any]]:
        """Split the values of a scene after its obstacles: those for a constraint, and the parameters by name.

        Args:
            values: The values; empty for an undefined sample, whose parameters are
                nominal.
            nominal: Result of ``nominal``.
        """
        if not len(self):
            return values, {}
        # The parameters are the last values.
        first = max(len(values) - len(self), 0)
        return values[:first], dict(
            zip(self.names, values[first:] if len(values) else nominal, strict=True)
        )

    def checked(self, values: Array) -> Array:
        """Return parameters of N samples, or of one for all, shape (N, width); check their shape and ranges.

        Raises:
            UsageError: The shape is wrong, or a value is outside its range.
        """
        if not len(self):
            raise UsageError(
                "must be None: the problem has no parameters", argument="parameters"
            )
        if values.ndim not in {1, 2} or values.shape[-1] != len(self):
            raise UsageError(
                f"must have shape (N, {len(self)}) for {', '.join(self.names)}, got {values.shape}",
                argument="parameters",
            )
        rows = values.reshape(-1, len(self))
        # Comparisons with nan are false, so that nan would pass; infinity is out of all
        # ranges.
        if text := self.out_of_range(np.nan_to_num(rows, nan=np.inf), shown=rows):
            raise UsageError(text, concerns="parameters", remedies=EXTRAPOLATE)
        return rows

    def out_of_range(self, rows: Array, *, shown: Array | None = None) -> str:
        """Return an error text if a value of shape (N, width) is outside of its range, otherwise "".

        Values that are not numbers pass: the verdict reports them. The text shows
        values of ``shown``, by default the same, and takes the remedies ``EXTRAPOLATE``.
        """
        for column, (name, span) in enumerate(
            zip(self.names, self.ranges, strict=True)
        ):
            rounding = RANGE_ROUNDING * max(abs(span.low), abs(span.high))
            outside = (rows[:, column] < span.low - rounding) | (
                rows[:, column] > span.high + rounding
            )
            if outside.any():
                row = int(outside.argmax())
                value = (rows if shown is None else shown)[row, column]
                low, high, got = distinct(span.low, span.high, value)
                text = f"{name} must be from {low} to {high}, got {got} in row {row}"
                return f"{text}; {{extrapolate}} allows values outside"
        return ""

    def widened(self, rows: Array) -> ParameterRanges:
        """Return the ranges that also contain values of shape (N, width); those that are not numbers are ignored.

        Raises:
            UsageError: A value is outside of the bounds of every range of its kind.
        """
        declared = {key.name: key for key in keys(type(self))}
        spans = {}
        for name, span, values in zip(self.names, self.ranges, rows.T, strict=True):
            finite = values[np.isfinite(values)].tolist()
            low = min(finite, default=span.low)
            high = max(finite, default=span.high)
            key = declared[name]
            # A range is widened up to the bounds of its key only.
            least = -np.inf if key.low is None else key.low
            largest = np.inf if key.high is None else key.high
            if low < least or high > largest:
                got = low if low < least else high
                raise UsageError(
                    f"{name} cannot be extrapolated to {got:g}, expected {least:g} to {largest:g}",
                    argument="parameters",
                )
            spans[name] = Range(min(low, span.low), max(high, span.high))
        return replace(self, **spans)

    def describe(self) -> Iterator[str]:
        """Yield a text of every parameter with its range in SI units."""
        for key in keys(type(self)):
            if (span := getattr(self, key.name)) is not None:
                yield f"{key.name} in [{span.low:.4g}, {span.high:.4g}]" + (
                    "" if key.unit == "1" else f" {key.unit}"
                )


NO_PARAMETERS = ParameterRanges()
PARAMETER_UNITS = {key.name: key.unit for key in keys(ParameterRanges)}
