"""Objects of known values, built without their checks."""

import numpy as np

from cnpgen.schema.unchecked import unchecked
from cnpgen.trajectory.spline_motion import Motion
from tests.refusals import is_refused


def test_an_unchecked_object_equals_a_checked_one():
    path, rate = np.zeros((1, 9, 2)), np.ones((1, 8))
    checked, made = Motion(path, rate, 7), unchecked(Motion, path, rate, 7)
    assert vars(made) == vars(checked)
    assert repr(made) == repr(checked)


def test_every_field_needs_a_value():
    with is_refused(ValueError):
        unchecked(Motion, np.zeros((1, 9, 2)))
