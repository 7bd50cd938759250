"""Boundary problems of a dataset or file, as plans without motions.

Rows of a certified dataset have motions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.arrays import AnyArray, Columns, Integers
from cnpgen.documents import Names
from cnpgen.errors import DatasetError, UsageError, lacks
from cnpgen.plans.format import (
    ATTRIBUTES,
    CONDITIONS,
    FORMAT,
    GOAL_OPTION,
    JOINT_NAMES,
    PLAN_FILE_VERSION,
    SI_UNITS,
    refuse_misspelt,
    refuse_other_joints,
    report_unused,
    stated_joints,
)
from cnpgen.plans.plan_file import agreed_problem, errors_of_file, stored_problem
from cnpgen.plans.plans import Plans, make_plans
from cnpgen.plans.plausible import check_boundary_units
from cnpgen.plans.stated_units import refuse_other_units
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import ProblemRecord, as_record, open_problem
from cnpgen.robots.robot import Robot
from cnpgen.robots.scene import scene_poses
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import integer
from cnpgen.store.checked_shard import Shard, read_rows
from cnpgen.store.dataset_spec import (
    DatasetSpec,
    StoredProblem,
    load_dataset_spec,
    shards,
)
from cnpgen.store.files.checksum_file import verify_checksum
from cnpgen.store.files.hdf5 import open_hdf5
from cnpgen.store.paths import HDF5_KINDS, require_file, require_folder
from cnpgen.store.reader import StoredDataset, open_dataset
from cnpgen.store.scene_table import OBSTACLE_POSES, SCENE_ID
from cnpgen.store.shard import SHARD_FORMAT
from cnpgen.trajectory.boundary import Boundary, boundary_of

CONTEXT = ("hit_angle", "hit_speed")  # dataset columns that plans keep
ASKED = (*CONDITIONS, "sample_id", OBSTACLE_POSES, GOAL_OPTION, *CONTEXT)
_OF_SHARDS = ("specification_fingerprint", "recipe_sha256", "first_sample_id", "rows")
SAID = (*ATTRIBUTES, *_OF_SHARDS)  # attributes


@dataclass(frozen=True, eq=False)
class BoundaryFile:
    """Present attributes of ``SAID`` and columns of ``ASKED`` in a file of N boundary problems; only names are checked.

    ``has_checksum`` is whether the file has a checksum, which was verified. ``joints``
    are the names of joints that a file of other software states: place -> names.
    """

    path: Path
    attributes: Mapping[str, Any]
    columns: Mapping[str, AnyArray]
    has_checksum: bool
    joints: Mapping[str, Names] = field(default_factory=dict)

    @property
    def is_shard(self) -> bool:
        """Whether it is a shard of a dataset."""
        return self.text("format") == SHARD_FORMAT

    def text(self, name: str) -> str:
        """Return an attribute as text; empty if it is missing."""
        value = self.attributes.get(name, "")
        return (
            value.decode(errors="replace") if isinstance(value, bytes) else str(value)
        )

    def spec(self) -> DatasetSpec | None:
        """Return the specification of the dataset that contains a shard.

        None for separate shards and other files.
        """
        if not self.is_shard:
            return None
        try:
            spec = load_dataset_spec(self.path.absolute().parents[1])
        except (DatasetError, IndexError):
            return None
        mine = self.text("specification_fingerprint")
        return (
            spec
            # A shard of an extended dataset may be of an earlier version of the
            # specification.
            if any(each.fingerprint == mine for each in spec.spec_versions)
            else None
        )

    def check_shard(self) -> None:
        """Raise DatasetError for a shard that differs from its dataset's specification; see ``read_rows``."""
        if spec := self.spec():
            folder = self.path.absolute().parents[1]
            name = "/".join(self.path.absolute().parts[-2:])
            for task in shards(spec):
                # Other files in the folder are not compared with the specification.
                if task.file == name:
                    read_rows(Shard(folder, spec, task))

    def problem(self, *, required: bool = True) -> ProblemRecord | None:
        """Return the problem named by the file or by its dataset.

        None if neither names one; see ``stored_problem``.
        """
        spec = self.spec()
        return (
            stored_problem(self.path, self.attributes, required=required)
            if spec is None
            else as_record(spec.problem)
        )

    def check_obstacles(self, problem: ProblemRecord) -> None:
        """Raise DatasetError if the file lacks the obstacles of its samples, and they place those of the problem."""
        if (
            OBSTACLE_POSES not in self.columns
            and open_problem(problem)[0].has_sample_obstacles
        ):
            remedy = (
                "give the folder of its dataset"
                if self.is_shard
                else f"expected {OBSTACLE_POSES}"
            )
            raise DatasetError(
                f"{self.path} lacks the obstacles of its samples: {remedy}"
            )

    def boundary(self, robot: Robot, *, allow_large_angles: bool = False) -> Boundary:
        """Return the boundary conditions of a robot's motions, shape (N, n) each.

        Raise DatasetError or UnitError.
        """
        boundary = boundary_in(str(self.path), self.columns, robot.n)
        if not allow_large_angles:
            check_boundary_units(robot, boundary, where=str(self.path))
        return boundary

    def sample_id(self, rows: int) -> Integers:
        """Return N sample IDs, 0, 1, ... by default.

        Raise DatasetError for others than integers or a shard's rows.
        """
        ids = self.columns.get("sample_id", np.arange(rows))
        if ids.shape != (rows,) or ids.dtype.kind not in "iu":
            raise DatasetError(
                f"{self.path}: sample_id must hold {rows} integers, got {ids.dtype} of {ids.shape}"
            )
        if self.is_shard and not self._has_indices(ids):
            raise DatasetError(
                f"{self.path}: sample_id is not the index of the row in the split"
            )
        return ids.astype(np.int64)

    def _has_indices(self, ids: AnyArray) -> bool:
        """Return whether sample IDs are the indices of all rows of a shard, by its attributes."""
        first, rows = (
            self.attributes.get(name) for name in ("first_sample_id", "rows")
        )
        if not isinstance(first, int | np.integer) or not isinstance(
            rows, int | np.integer
        ):
            return False
        return len(ids) == rows and (
            "sample_id" not in self.columns
            or np.array_equal(ids, first + np.arange(rows))
        )


def read_boundary_file(path: Path) -> BoundaryFile:
    """Read an HDF5 file of boundary conditions; see ``load_boundary_problems``.

    Raises:
        UsageError: The file does not exist or is of another kind.
        DatasetError: The file is damaged, or a required name is missing or misspelled.
        MachineError: The file cannot be read.
    """
    require_file(
        path, "a dataset or an HDF5 file of boundary conditions", kinds=HDF5_KINDS
    )
    # Before HDF5 reads the file, which may hang on a damaged one.
    has_checksum = verify_checksum(path, kind=FORMAT, version=PLAN_FILE_VERSION)
    with open_hdf5(path) as file:
        attributes = file.attributes.some(SAID)
        columns = {name: file[name].read() for name in ASKED if name in file}
        names = file.names()
        found = BoundaryFile(path, attributes, columns, has_checksum)
        if not has_checksum and not found.is_shard:
            # Files of cnpgen are complete.
            refuse_misspelt(path, names, ASKED)
            refuse_other_units(file, {name: SI_UNITS.get(name, "") for name in ASKED})
            known = *SAID, JOINT_NAMES
            report_unused(path, file, known, (*ASKED, JOINT_NAMES))
            found = replace(found, joints=stated_joints(file))
    found.check_shard()
    missing = [name for name in ("start_q", "goal_q") if name not in columns]
    if missing:
        tasks = any(name.startswith("goal_xyz") for name in names)
        hint = (
            "; of tasks in the workspace 'cnpgen complete' makes them" if tasks else ""
        )
        raise DatasetError(
            f"{path} lacks {' and '.join(missing)}: boundary conditions are needed to plan{hint}"
        )
    return found


def boundary_in(where: str, columns: Mapping[str, AnyArray], n: int) -> Boundary:
    """Read boundary conditions of n joints from columns; missing ones are zero, missing goal accelerations are free.

    Wrong shapes of columns, name -> values of shape (N, n), and values that are not
    finite raise DatasetError.
    """
    given = {name: columns[name] for name in CONDITIONS if name in columns}
    try:
        boundary = boundary_of(n, *map(given.get, CONDITIONS))  # type: ignore[arg-type]
    except UsageError as error:
        raise DatasetError(f"{where}: {error}") from error
    # in files, one row does not broadcast to all
    for name, values in given.items():
        # Parameters have their own width, all other conditions one column per joint.
        width = values.shape[-1] if name == "parameters" else n
        if values.size != len(boundary) * width:
            raise DatasetError(
                f"{where}: {name} has shape {values.shape}, expected ({len(boundary)}, {width})"
            )
    return boundary


@checked_arguments
def load_boundary_problems(
    path: str | Path,
    *,
    split: str | None = None,
    start: int | None = None,
    n: int | None = None,
    problem: Problem | StoredProblem | str | Path | None = None,
    allow_large_angles: bool = False,
    extrapolate: bool = False,
) -> Plans:
    """Read boundary problems as plans without motions for ``solve_plans``: their control points are nan.

    Rows of a certified dataset have the stored plans. From a file, only the boundary
    conditions are read; ``load_plans`` reads its plans.

    Args:
        path: Folder of a dataset, or an HDF5 file of boundary conditions: a shard, a
            file of plans, or any other with ``start_q`` and ``goal_q`` of shape (N,
            joints), and ``start_dq``, ``start_ddq`` and ``goal_dq`` unless they are
            zero, and ``goal_ddq`` unless goal accelerations are free.
        split: Split of the dataset; "train" by default.
        start: First row of the split; 0 by default.
        n: Number of rows; by default all that follow.
        allow_large_angles: Whether to accept boundary conditions in a file that are
            probably in degrees or millimetres.
        problem: Required problem of a file: name, path, problem or record. Its
            tolerances replace those in the file.
        extrapolate: Whether parameters in a file may be outside of their ranges; see
            ``load_plans``.

    Raises:
        DatasetError: The dataset or the file cannot be read, is incomplete or is of
            another problem.
        UsageError: The folder, file, split or rows do not exist, or rows of a file are
            requested.
        UnitError: Boundary conditions of a file are probably in degrees or millimetres.
        RecipeError: ``problem`` has errors.
    """
    path = Path(path)
    if path.is_file() or (path.suffix == ".h5" and not path.is_dir()):
        if (split, start, n) != (None, None, None):
            raise UsageError(
                f"split, start and n choose rows of the folder of a dataset, {path} is a file",
                concerns="split",
            )
        return _of_file(
            path,
            None if problem is None else as_record(problem),
            allow_large_angles=allow_large_angles,
            extrapolate=extrapolate,
        )
    require_folder(path, argument="path")
    if problem is not None:
        raise UsageError(
            f"problem says which problem a file is of: {path} is the folder of a dataset, which says it",
            concerns="problem",
        )
    return _of_folder(path, split or "train", 0 if start is None else start, n)


def _of_folder(folder: Path, split: str, start: int, n: int | None) -> Plans:
    """Return rows of a dataset."""
    dataset = open_dataset(folder)
    rows = chosen_rows(folder, dataset.spec, split=split, start=start, n=n)
    source = f"dataset {dataset.spec.name}, seed {dataset.spec.seed}, split {split}"
    columns = dataset.read(split, start=rows.start, stop=rows.stop)
    columns |= scene_columns(dataset, split, rows, columns)
    return plans_of_rows(as_record(dataset.spec.problem), columns, source=source)


def scene_columns(
    dataset: StoredDataset, split: str, rows: range, columns: Mapping[str, AnyArray]
) -> Columns:
    """Return the column with the obstacles of rows of a dataset, by ``scene_id``.

    None if samples have no scenes.
    """
    if not dataset.spec.scene_obstacles:
        return {}
    scenes = dataset.read_scenes(split, start=rows.start, stop=rows.stop)
    obstacles = open_problem(as_record(dataset.spec.problem))[0].obstacle
    return {
        OBSTACLE_POSES: scene_poses(
            obstacles, scenes[scenes.rows_of(columns[SCENE_ID])]
        )
    }


def chosen_rows(
    folder: Path, spec: DatasetSpec, *, split: str, start: int, n: int | None
) -> range:
    """Return n rows of a split from ``start`` on, by default all remaining ones.

    Raise UsageError for others.
    """
    start = integer("start", start, least=0)
    if split not in spec.splits:
        raise UsageError(
            f"{folder} {lacks('split', split, spec.splits)}", concerns="split"
        )
    # Ranges are refused where they end outside the split, not shortened.
    rows = spec.splits[split]
    stop = rows if n is None else start + integer("n", n, least=1)
    if not start < stop <= rows:
        wanted = f"{max(stop - start, 1)} from row {start} on"
        raise UsageError(
            f"split {split!r} of {folder} has {rows} rows, got {wanted}", concerns="n"
        )
    return range(start, stop)


def _of_file(
    path: Path,
    wanted: ProblemRecord | None,
    *,
    allow_large_angles: bool,
    extrapolate: bool,
) -> Plans:
    """Return the boundary problems of a file."""
    file = read_boundary_file(path)
    problem = agreed_problem(
        path,
        file.problem(required=wanted is None),
        wanted,
        content="boundary problems",
        command="solve",
        parameters=file.columns.get("parameters", ()) if extrapolate else None,
    )
    recorded = file.text("problem_sha256")
    if recorded and recorded != problem.comparable_sha256:
        raise DatasetError(
            f"{path} is of another problem than {problem.name!r}: its problem_sha256 is not this one's"
        )
    refuse_other_joints(path, file.joints, problem.joint_names)
    # Parked obstacles would be planned around in place of those of the samples.
    file.check_obstacles(problem)
    boundary = file.boundary(
        open_problem(problem)[1], allow_large_angles=allow_large_angles
    )
    columns = {
        **file.columns,
        **boundary.arrays(),
        "sample_id": file.sample_id(len(boundary)),
    }
    with errors_of_file(path):
        plans = plans_of_rows(
            problem, columns, source=f"boundary conditions in {path.name}"
        )
    return replace(plans, has_checksum=file.has_checksum)


def plans_of_rows(
    problem: ProblemRecord, columns: Mapping[str, AnyArray], *, source: str = ""
) -> Plans:
    """Return rows of a dataset, columns as in shards, as plans: those of a certified dataset, or of nan."""
    spec = problem.trajectory
    rows, n = columns["start_q"].shape
    kept = ("start_xyz", "goal_xyz", OBSTACLE_POSES, GOAL_OPTION, *CONTEXT)
    # Rows without motions get control points of nan in the shape that the problem
    # suggests.
    points = spec.path_control_points
    rates = spec.rate_control_points
    path, rate = (
        columns.get(f"{part}_control_points", np.array(np.nan))
        for part in ("path", "rate")
    )
    return make_plans(
        problem,
        Boundary.from_batch(columns, None),
        path_control_points=np.array(np.broadcast_to(path, (rows, points * n))).reshape(
            rows, points, n
        ),
        rate_control_points=np.array(np.broadcast_to(rate, (rows, rates))),
        columns={name: columns[name] for name in kept if name in columns},
        sample_id=columns.get("sample_id"),
        source=source,
        # Checked with the file or the tasks.
        allow_large_angles=True,
    )
