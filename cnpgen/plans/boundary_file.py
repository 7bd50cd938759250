"""Boundary conditions in HDF5: in a shard, in a file of plans, or with nothing beside them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import DatasetError, UsageError
from cnpgen.plans.format import ATTRIBUTES, CONDITIONS, refuse_misspelt
from cnpgen.plans.format import FORMAT as PLANS
from cnpgen.plans.format import FORMAT_VERSION as PLANS_VERSION
from cnpgen.plans.load import stored_problem
from cnpgen.problems.record import ProblemRecord, as_record
from cnpgen.store.blueprint import Blueprint, load_blueprint
from cnpgen.store.files.hdf5 import opened_hdf5
from cnpgen.store.files.sealed import has_seal
from cnpgen.store.paths import file_kind, require_file
from cnpgen.store.shard import FORMAT
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.boundary_arguments import boundary_of

CONTEXT = ("hit_angle", "hit_speed")  # columns of a dataset that plans keep
ASKED = (*CONDITIONS, "sample_id", *CONTEXT)
SAID = (*ATTRIBUTES, "plan_fingerprint", "recipe_sha256")  # attributes, the last two of shards


@dataclass(frozen=True, eq=False)
class BoundaryFile:
    """What a file says of N boundary problems; only names are checked.

    Attributes:
        path: The file.
        attributes: Those of ``SAID`` that it has.
        columns: Those of ``ASKED`` that it has: name -> values.
        sealed: Whether it has a checksum, which is right, as files of plans have.
    """

    path: Path
    attributes: Mapping[str, Any]
    columns: Mapping[str, NDArray[Any]]
    sealed: bool

    @property
    def is_shard(self) -> bool:
        """Whether it is a shard of a dataset."""
        return self.text("format") == FORMAT

    def text(self, name: str) -> str:
        """Return an attribute as text; nothing where there is none."""
        value = self.attributes.get(name, "")
        return value.decode(errors="replace") if isinstance(value, bytes) else str(value)

    def blueprint(self) -> Blueprint | None:
        """Return the blueprint of the dataset that a shard lies in; None if it was taken out of it, or is no shard."""
        if not self.is_shard:
            return None
        try:
            blueprint = load_blueprint(self.path.absolute().parents[1])
        except (DatasetError, IndexError):
            return None
        mine = self.text("plan_fingerprint")
        return blueprint if any(each.fingerprint == mine for each in blueprint.generations) else None

    def problem(self) -> ProblemRecord | None:
        """Return the problem that the file, or the dataset that it lies in, says it is of; None if neither does.

        Raises:
            DatasetError: It says one that is damaged or cannot be found.
        """
        blueprint = self.blueprint()
        return stored_problem(self.path, self.attributes) if blueprint is None else as_record(blueprint.problem)

    def boundary(self, n: int) -> Boundary:
        """Return the boundary conditions of motions of n joints, shape (N, n) each.

        Raises:
            DatasetError: A shape is wrong, or something is not finite.
        """
        return boundary_in(str(self.path), self.columns, n)

    def sample_id(self, rows: int) -> NDArray[np.int64]:
        """Return which samples of a dataset the N boundary problems are, shape (N,); 0, 1, ... where it does not say.

        Raises:
            DatasetError: What it has are not N integers.
        """
        ids = self.columns.get("sample_id", np.arange(rows))
        if ids.shape != (rows,) or ids.dtype.kind not in "iu":
            raise DatasetError(f"{self.path}: sample_id must hold {rows} integers, got {ids.dtype} of {ids.shape}")
        return ids.astype(np.int64)


def read_boundary_file(path: Path) -> BoundaryFile:
    """Read an HDF5 file of boundary conditions.

    Args:
        path: The file, with datasets ``start_q`` and ``goal_q`` of shape (N, n), and ``start_dq``, ``start_ddq`` and
            ``goal_dq`` where they are not zero.

    Raises:
        UsageError: There is no such file.
        DatasetError: It is damaged, something else, or lacks something, or a name in it is almost one that it lacks.
        MachineError: The system would not let us read it.
    """
    require_file(path, "a dataset or an HDF5 file of boundary conditions")
    if (kind := file_kind(path)).endswith(" of cnpgen"):
        raise DatasetError(f"{path} is {kind}, not an HDF5 file of boundary conditions")
    sealed = has_seal(path, kind=PLANS, version=PLANS_VERSION)
    with opened_hdf5(path) as file:
        attributes = file.attributes.some(SAID)
        columns = {name: file[name].read() for name in ASKED if name in file}
        names = file.names()
    found = BoundaryFile(path, attributes, columns, sealed)
    if not sealed and not found.is_shard:  # what cnpgen has written is as it is meant
        refuse_misspelt(path, names, ASKED)
    missing = [name for name in ("start_q", "goal_q") if name not in columns]
    if missing:
        tasks = any(name.startswith("goal_xyz") for name in names)
        hint = "; of tasks in the workspace 'cnpgen complete' makes them" if tasks else ""
        raise DatasetError(f"{path} lacks {' and '.join(missing)}: boundary conditions are needed to plan{hint}")
    return found


def boundary_in(where: str, columns: Mapping[str, NDArray[Any]], n: int) -> Boundary:
    """Take boundary conditions of n joints out of named columns; what is missing is zero, goal accelerations free.

    Args:
        where: Where they are from, for messages.
        columns: Name -> values, shape (N, n); N is the same for all.
        n: Number of planned joints.

    Raises:
        DatasetError: A shape is wrong, or something is not finite.
    """
    given = {name: columns[name] for name in CONDITIONS if name in columns}
    try:
        boundary = boundary_of(n, *map(given.get, CONDITIONS))  # type: ignore[arg-type]
    except UsageError as error:
        raise DatasetError(f"{where}: {error}") from error
    for name, values in given.items():  # in files one row does not hold for all
        if values.size != len(boundary) * n:
            raise DatasetError(f"{where}: {name} has shape {values.shape}, expected ({len(boundary)}, {n})")
    return boundary
