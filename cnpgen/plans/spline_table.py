"""Export format of path splines: the HDF5 table that Motion Planning Diffusion trains on (Carvalho et al. 2025)."""

import io
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError
from cnpgen.plans.exporter import ExportedSet, Exporter, SampledPlan
from cnpgen.store.files.atomic import write_file
from cnpgen.store.files.hdf5 import create_hdf5
from cnpgen.trajectory.spline_motion import Motion

WAYPOINTS = 128  # of a path, equidistant in phase


@dataclass(frozen=True)
class PathSplines(Exporter):
    """One HDF5 file with the paths of all plans as clamped B-splines over [0, 1]; durations are in a column.

    For N paths with C control points: ``bspline_params_tt`` (N, C + d + 1), ``bspline_params_cc`` (N, n, C),
    ``bspline_params_k`` (N,), ``sol_path`` (N, 128, n) [rad], ``task_id`` (N,), ``q_start`` and ``q_goal`` (N, n), and
    ``duration`` (N,) [s].
    """

    suffix = ".hdf5"
    single_file = True

    def write(self, path: Path, plans: Iterable[SampledPlan], exported: ExportedSet) -> None:
        """Write the file; see ``Exporter.write``."""
        del plans  # splines are not sampled in time
        motion = exported.motion
        if motion is None:
            raise UsageError("joined plans have no single spline: choose another format", concerns="to")
        import h5py

        buffer = io.BytesIO()
        with h5py.File(create_hdf5(buffer)) as file:
            for name, values in _columns(motion, exported).items():
                file.create_dataset(name, data=values, track_times=False)
            file.attrs["joint_names"] = list(exported.joint_names)
            file.attrs["problem"] = exported.problem
        write_file(path, buffer.getvalue())


def _columns(motion: Motion, exported: ExportedSet) -> dict[str, NDArray[np.float64] | NDArray[np.int64]]:
    """Return the datasets of the file."""
    from scipy.interpolate import BSpline

    count, points, degree = len(motion.path), motion.path.shape[1], motion.degree
    inner = np.linspace(0, 1, points - degree + 1)
    knots = np.concatenate([np.zeros(degree), inner, np.ones(degree)])
    control = motion.path.transpose(1, 0, 2)
    waypoints = BSpline(knots, control, degree)(np.linspace(0, 1, WAYPOINTS)).transpose(1, 0, 2)
    return {
        "bspline_params_tt": np.tile(knots, (count, 1)),
        "bspline_params_cc": np.ascontiguousarray(motion.path.transpose(0, 2, 1)),
        "bspline_params_k": np.full(count, degree, np.int64),
        "sol_path": np.ascontiguousarray(waypoints),
        "task_id": exported.sample_id,
        "q_start": motion.path[:, 0],
        "q_goal": motion.path[:, -1],
        "duration": motion.duration(),
    }
