"""Boundary conditions in HDF5 files: shards, plan files, or files of boundary conditions only."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import DatasetError, UsageError
from cnpgen.plans.format import ATTRIBUTES, CONDITIONS, GOAL_OPTION, OBSTACLE_POSES, refuse_misspelt
from cnpgen.plans.format import FORMAT as PLANS
from cnpgen.plans.format import PLAN_FILE_VERSION as PLANS_VERSION
from cnpgen.plans.plan_file import stored_problem
from cnpgen.plans.plausible import check_boundary_units
from cnpgen.problems.problem_record import ProblemRecord, as_record, open_problem
from cnpgen.robots.robot import Robot
from cnpgen.store.checked_shard import Shard, read_rows
from cnpgen.store.dataset_spec import DatasetSpec, load_dataset_spec, shards
from cnpgen.store.files.checksum_file import verify_checksum
from cnpgen.store.files.hdf5 import opened_hdf5
from cnpgen.store.paths import HDF5_KINDS, require_file
from cnpgen.store.shard import SHARD_FORMAT
from cnpgen.trajectory.boundary import Boundary, boundary_of

CONTEXT = ("hit_angle", "hit_speed")  # dataset columns that plans keep
ASKED = (*CONDITIONS, "sample_id", OBSTACLE_POSES, GOAL_OPTION, *CONTEXT)
_OF_SHARDS = ("specification_fingerprint", "recipe_sha256", "first_sample_id", "rows")
SAID = (*ATTRIBUTES, *_OF_SHARDS)  # attributes


@dataclass(frozen=True, eq=False)
class BoundaryFile:
    """Contents of a file of N boundary problems; only names are checked.

    Attributes:
        path: Path of the file.
        attributes: Present attributes among ``SAID``.
        columns: Present columns among ``ASKED``: name -> values.
        has_checksum: Whether the file has a checksum, which was verified.
    """

    path: Path
    attributes: Mapping[str, Any]
    columns: Mapping[str, NDArray[Any]]
    has_checksum: bool

    @property
    def is_shard(self) -> bool:
        """Whether it is a shard of a dataset."""
        return self.text("format") == SHARD_FORMAT

    def text(self, name: str) -> str:
        """Return an attribute as text; empty if it is missing."""
        value = self.attributes.get(name, "")
        return value.decode(errors="replace") if isinstance(value, bytes) else str(value)

    def spec(self) -> DatasetSpec | None:
        """Return the specification of the dataset that contains a shard; None for separate shards and other files."""
        if not self.is_shard:
            return None
        try:
            spec = load_dataset_spec(self.path.absolute().parents[1])
        except (DatasetError, IndexError):
            return None
        mine = self.text("specification_fingerprint")
        return spec if any(each.fingerprint == mine for each in spec.spec_versions) else None

    def check_shard(self) -> None:
        """Compare a shard in its dataset with the specification; see ``read_rows``.

        Raises:
            DatasetError: They differ, or a value is not finite.
        """
        if spec := self.spec():
            folder, name = self.path.absolute().parents[1], "/".join(self.path.absolute().parts[-2:])
            for task in shards(spec):
                if task.file == name:
                    read_rows(Shard(folder, spec, task))

    def problem(self, *, required: bool = True) -> ProblemRecord | None:
        """Return the problem named by the file or by its dataset; None if neither names one; see ``stored_problem``.

        Raises:
            DatasetError: The named problem is damaged or cannot be found.
        """
        spec = self.spec()
        return (
            stored_problem(self.path, self.attributes, required=required) if spec is None else as_record(spec.problem)
        )

    def check_obstacles(self, problem: ProblemRecord) -> None:
        """Check that the file has the obstacles of its samples if they place those of the problem.

        Raises:
            DatasetError: They are missing.
        """
        if OBSTACLE_POSES not in self.columns and open_problem(problem)[0].has_sample_obstacles:
            remedy = "give the folder of its dataset" if self.is_shard else f"expected {OBSTACLE_POSES}"
            raise DatasetError(f"{self.path} lacks the obstacles of its samples: {remedy}")

    def boundary(self, robot: Robot, *, allow_large_angles: bool = False) -> Boundary:
        """Return the boundary conditions of motions of a robot, shape (N, n) each.

        Args:
            robot: Robot of the problem.
            allow_large_angles: Whether to accept values that are probably in another unit than rad or m.

        Raises:
            DatasetError: A shape is wrong, or a value is not finite.
            UnitError: A value is so far outside of its range that it is probably in degrees or millimetres.
        """
        boundary = boundary_in(str(self.path), self.columns, robot.n)
        if not allow_large_angles:
            check_boundary_units(robot, boundary, where=str(self.path))
        return boundary

    def sample_id(self, rows: int) -> NDArray[np.int64]:
        """Return the sample IDs of the N boundary problems, shape (N,); 0, 1, ... by default.

        Raises:
            DatasetError: The sample IDs are not N integers, or not the indices of the rows of a shard.
        """
        ids = self.columns.get("sample_id", np.arange(rows))
        if ids.shape != (rows,) or ids.dtype.kind not in "iu":
            raise DatasetError(f"{self.path}: sample_id must hold {rows} integers, got {ids.dtype} of {ids.shape}")
        if self.is_shard and not self._has_indices(ids):
            raise DatasetError(f"{self.path}: sample_id is not the index of the row in the split")
        return ids.astype(np.int64)

    def _has_indices(self, ids: NDArray[Any]) -> bool:
        """Return whether sample IDs are the indices of all rows of a shard, by its attributes."""
        first, rows = (self.attributes.get(name) for name in ("first_sample_id", "rows"))
        if not isinstance(first, int | np.integer) or not isinstance(rows, int | np.integer):
            return False
        return len(ids) == rows and ("sample_id" not in self.columns or np.array_equal(ids, first + np.arange(rows)))


def read_boundary_file(path: Path) -> BoundaryFile:
    """Read an HDF5 file of boundary conditions.

    Args:
        path: File with datasets ``start_q`` and ``goal_q`` of shape (N, n), and ``start_dq``, ``start_ddq``
            and ``goal_dq`` unless they are zero.

    Raises:
        UsageError: The file does not exist or is of another kind.
        DatasetError: The file is damaged, or a required name is missing or misspelled.
        MachineError: The file cannot be read.
    """
    require_file(path, "a dataset or an HDF5 file of boundary conditions", kinds=HDF5_KINDS)
    has_checksum = verify_checksum(path, kind=PLANS, version=PLANS_VERSION)
    with opened_hdf5(path) as file:
        attributes = file.attributes.some(SAID)
        columns = {name: file[name].read() for name in ASKED if name in file}
        names = file.names()
    found = BoundaryFile(path, attributes, columns, has_checksum)
    found.check_shard()
    if not has_checksum and not found.is_shard:  # files of cnpgen are complete
        refuse_misspelt(path, names, ASKED)
    missing = [name for name in ("start_q", "goal_q") if name not in columns]
    if missing:
        tasks = any(name.startswith("goal_xyz") for name in names)
        hint = "; of tasks in the workspace 'cnpgen complete' makes them" if tasks else ""
        raise DatasetError(f"{path} lacks {' and '.join(missing)}: boundary conditions are needed to plan{hint}")
    return found


def boundary_in(where: str, columns: Mapping[str, NDArray[Any]], n: int) -> Boundary:
    """Read boundary conditions of n joints from columns; missing ones are zero, missing goal accelerations are free.

    The columns, name -> values of shape (N, n), have a source for messages.

    Raises:
        DatasetError: A shape is wrong, or a value is not finite.
    """
    given = {name: columns[name] for name in CONDITIONS if name in columns}
    try:
        boundary = boundary_of(n, *map(given.get, CONDITIONS))  # type: ignore[arg-type]
    except UsageError as error:
        raise DatasetError(f"{where}: {error}") from error
    for name, values in given.items():  # in files, one row does not broadcast to all
        width = values.shape[-1] if name == "parameters" else n
        if values.size != len(boundary) * width:
            raise DatasetError(f"{where}: {name} has shape {values.shape}, expected ({len(boundary)}, {width})")
    return boundary
