"""Export format of Parquet: one table with one row per sample, for Polars, DuckDB and the viewer of a hub."""

import io
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import requires_extra
from cnpgen.plans.exporter import ExportedSet, Exporter, SampledPlan, parameter_columns
from cnpgen.plans.format import UNITS
from cnpgen.plans.trajectory_tables import JOINT_NAMES_KEY, PHASE_COLUMN, PLAN_COLUMN
from cnpgen.store.files.atomic import committing, write_file
from cnpgen.store.joint_units import units_of_joints


@dataclass(frozen=True)
class ParquetTable(Exporter):
    """One Parquet file with all plans, one row per sample.

    Columns are ``plan``, ``sample_id``, ``t`` [s], ``q``, ``dq``, ``ddq`` and ``jerk`` as lists of n values,
    ``path_phase`` and the parameters of the problem, such as ``payload_mass [kg]``. The metadata have the names of the
    joints and the units. Every plan is a row group.
    """

    suffix = ".parquet"
    single_file = True

    def write(self, path: Path, plans: Iterable[SampledPlan], exported: ExportedSet) -> None:
        """Write the table plan by plan; see ``Exporter.write``."""
        with requires_extra("parquet", "pyarrow"):
            import pyarrow
            import pyarrow.parquet

        units = {"t": "s"} | {name: units_of_joints(unit, exported.prismatic) for name, unit in UNITS.items()}
        held = json.dumps(exported.held_joints)
        metadata = {JOINT_NAMES_KEY: json.dumps(exported.joint_names), "units": json.dumps(units), "held_joints": held}
        lists = {name: pyarrow.list_(pyarrow.float64(), len(exported.joint_names)) for name in UNITS}
        whole = {PLAN_COLUMN: pyarrow.int64(), "sample_id": pyarrow.int64()}
        parameters = dict.fromkeys(parameter_columns(exported.parameters), pyarrow.float64())
        phase = {} if exported.motion is None else {PHASE_COLUMN: pyarrow.float64()}
        schema = pyarrow.schema({**whole, "t": pyarrow.float64(), **lists, **phase, **parameters}, metadata=metadata)
        samples = dict(zip(exported.index.tolist(), exported.sample_id.tolist(), strict=True))
        with committing(path) as temporary, pyarrow.parquet.ParquetWriter(temporary, schema) as writer:
            for plan in plans:
                count = len(plan.t)
                whole_values = [np.full(count, plan.index), np.full(count, samples[plan.index]), plan.t]
                columns = [pyarrow.array(values) for values in whole_values]
                columns += [fixed_lists(getattr(plan, name)) for name in UNITS]
                columns += [pyarrow.array(plan.phase)] if phase else []
                columns += [pyarrow.array(np.full(count, value)) for value in plan.parameters]
                writer.write_table(pyarrow.table(columns, schema=schema))


def fixed_lists(values: NDArray[Any]) -> Any:
    """Return an array of shape (K, w) as K lists of w values."""
    import pyarrow

    flat = pyarrow.array(np.ascontiguousarray(values).ravel())
    return pyarrow.FixedSizeListArray.from_arrays(flat, values.shape[1])


def write_parquet(path: Path, table: Any) -> None:
    """Write a table of pyarrow, atomically."""
    import pyarrow.parquet

    buffer = io.BytesIO()
    pyarrow.parquet.write_table(table, buffer)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, buffer.getvalue())
