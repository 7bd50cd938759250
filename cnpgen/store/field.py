"""A field of a dataset: the name, shape, unit and description of one HDF5 dataset."""

from dataclasses import dataclass

from cnpgen.store.joint_units import unit_of


@dataclass(frozen=True)
class Field:
    """One named column block of a shard, stored as ``(rows, width)`` or ``(rows,)`` when ``width`` is 0.

    Attributes:
        name: HDF5 dataset name at the root of the shard.
        unit: SI unit as text: "rad", "rad/s", "rad/s^2", "m", "m/s", "N m", "1"; or one
            per joint, separated by commas, if some joints are prismatic and others
            revolute.
        long_name: Description in a few words.
        width: Number of columns; 0 for a scalar per row.
        names: Names of the columns (joints, axes), empty for scalars.
        role: "input", "target", "context" or "diagnostic".
        frame: Reference frame of Cartesian fields, otherwise "".
        valid_min: Lower limit of every column, shape (max(width, 1),), or None.
        valid_max: Upper limit of every column, or None.
        dtype: "float" (stored in the dataset's float type) or "int64".
    """

    name: str
    unit: str
    long_name: str
    width: int = 0
    names: tuple[str, ...] = ()
    role: str = "input"
    frame: str = ""
    valid_min: tuple[float, ...] | None = None
    valid_max: tuple[float, ...] | None = None
    dtype: str = "float"

    def __post_init__(self) -> None:
        # Floats, as read from JSON, because they are part of the fingerprint.
        for name in ("valid_min", "valid_max"):
            limits = getattr(self, name)
            if limits is not None:
                object.__setattr__(self, name, tuple(map(float, limits)))

    def shape(self, rows: int) -> tuple[int, ...]:
        """Shape of the values of ``rows`` rows."""
        return (rows, self.width) if self.width else (rows,)

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of every column."""
        return tuple(unit_of(self.unit, column) for column in range(max(self.width, 1)))

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns in a table of several fields: ``"start_q.joint_1"``, or ``"hit_speed"`` of a scalar."""
        # Columns without names are numbered.
        names = self.names or tuple(map(str, range(self.width)))
        return (
            tuple(f"{self.name}.{name}" for name in names)
            if self.width
            else (self.name,)
        )


Fields = tuple[Field, ...]
"""The fields of a dataset, or those that a stage fills, in their order."""
