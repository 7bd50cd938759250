"""A sampled plan as a table of comma-separated values."""

import csv
import io

import numpy as np

from cnpgen.export.sampled import Sampled

UNITS = {"q": "rad", "dq": "rad/s", "ddq": "rad/s^2", "jerk": "rad/s^3"}


def csv_table(sampled: Sampled, joints: tuple[str, ...]) -> str:
    """Write a table; every number reads back as the same float64."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["t [s]", *(f"{name} {joint} [{unit}]" for name, unit in UNITS.items() for joint in joints)])
    columns = [getattr(sampled, name) for name in UNITS]
    writer.writerows(np.column_stack([sampled.t, *columns]).tolist())
    return text.getvalue()
