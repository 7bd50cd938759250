"""Rotations within the tolerances of a rotation vector are within those of the XYZ Euler angles, by SciPy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cnpgen.addons.scene_files.euler_tolerance import rotation_vector_tolerance
from tests.refusals import is_refused


@pytest.mark.parametrize("free", [None, 0, 2])
def test_the_rotation_vectors_meet_the_angles(free: int | None) -> None:
    random = np.random.default_rng(1)
    for _ in range(500):
        angles = 10 ** random.uniform(-3, 0.49, 3)
        if free is not None:
            angles[free] = np.pi
        inner = rotation_vector_tolerance(angles)
        vectors = random.uniform(-1, 1, (200, 3))
        vectors[::2] = np.sign(vectors[::2])  # corners, where the angles are largest
        found = np.abs(Rotation.from_rotvec(vectors * inner).as_euler("XYZ"))
        assert (found <= np.where(angles >= np.pi, np.inf, angles) + 1e-12).all()


def test_small_tolerances_are_kept_to_second_order() -> None:
    inner = rotation_vector_tolerance(np.array([0.01, 0.01, 0.01]))
    np.testing.assert_allclose(inner, 0.01, rtol=0.01)
    np.testing.assert_array_equal(rotation_vector_tolerance(np.full(3, np.pi)), np.pi)


@pytest.mark.parametrize("angles", [[0.1, np.pi, 0.1], [np.pi, 0.1, np.pi]])
def test_angles_that_are_free_about_y_or_two_axes_are_refused(
    angles: list[float],
) -> None:
    with is_refused(ValueError):
        rotation_vector_tolerance(np.array(angles))
