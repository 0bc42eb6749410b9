"""Rigid transforms against scipy's Rotation, and their algebra under random inputs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from wheelset_assets.metrology import rigid

coordinate = st.floats(-1e3, 1e3, allow_nan=False, width=64)
vectors = st.tuples(coordinate, coordinate, coordinate).map(np.array)
angles = st.floats(1e-12, np.pi) | st.sampled_from([1e-9, 1e-8, 1e-5, np.pi - 1e-9, np.pi])
directions = st.integers(0, 2**32 - 1).map(lambda seed: np.random.default_rng(seed).standard_normal(3))
rotation_vectors = st.tuples(angles, directions).map(lambda a: a[0] * a[1] / np.linalg.norm(a[1]))
transforms = st.tuples(rotation_vectors, vectors).map(lambda a: rigid.transform(rigid.rotation_from_vector(a[0]), a[1]))

# A rotation matrix in double precision is right to a few eps = 2.2e-16; products of a handful stay below 1e-13.
ROUNDING = 1e-13


@given(rotation_vectors)
def test_rotation_from_vector_is_scipys(vector):
    assert np.allclose(
        rigid.rotation_from_vector(vector), Rotation.from_rotvec(vector).as_matrix(), atol=ROUNDING, rtol=0
    )


@given(rotation_vectors)
def test_vector_survives_the_way_through_a_matrix(vector):
    back = rigid.vector_from_rotation(rigid.rotation_from_vector(vector))
    # At half a turn the axis' sign is free; a matrix tells the angle near pi to sqrt(eps) only through its diagonal,
    # but the quaternion keeps it to eps.
    if np.linalg.norm(vector) > np.pi - 1e-7:
        back = back * np.sign(back @ vector)
    assert np.allclose(back, vector, atol=1e-9 if np.linalg.norm(vector) > np.pi - 1e-3 else ROUNDING * 10, rtol=0)


@given(rotation_vectors)
def test_vector_from_rotation_is_scipys_and_at_most_half_a_turn(vector):
    rotation = Rotation.from_rotvec(vector)
    found = rigid.vector_from_rotation(rotation.as_matrix())
    assert np.linalg.norm(found) <= np.pi + 1e-12
    assert (Rotation.from_rotvec(found).inv() * rotation).magnitude() < 1e-9


@given(rotation_vectors)
def test_quaternion_is_scipys_and_has_a_real_part_that_is_not_negative(vector):
    q = rigid.quaternion_from_rotation(rigid.rotation_from_vector(vector))
    x, y, z, w = Rotation.from_rotvec(vector).as_quat()
    theirs = np.array([w, x, y, z])
    assert q[0] >= 0
    assert min(np.abs(q - theirs).max(), np.abs(q + theirs).max()) < 1e-9  # eigenvectors: square root of nothing lost
    assert np.linalg.norm(q) == pytest.approx(1, abs=1e-12)


@given(rotation_vectors, st.floats(0.01, 100))
def test_rotation_from_quaternion_ignores_its_length(vector, length):
    rotation = rigid.rotation_from_vector(vector)
    again = rigid.rotation_from_quaternion(length * rigid.quaternion_from_rotation(rotation))
    assert np.allclose(again, rotation, atol=1e-12, rtol=0)


@given(vectors, vectors)
def test_skew_is_the_cross_product(v, w):
    assert np.allclose(rigid.skew(v) @ w, np.cross(v, w), atol=1e-9)  # products up to 1e6: eps 2e-10
    assert np.array_equal(rigid.skew(v).T, -rigid.skew(v))


@given(transforms)
def test_inverse_undoes(b_from_a):
    assert np.allclose(rigid.inverse(b_from_a) @ b_from_a, np.eye(4), atol=1e-9, rtol=0)  # coordinates up to 1e3
    assert np.allclose(rigid.inverse(rigid.inverse(b_from_a)), b_from_a, atol=1e-9, rtol=0)


@given(transforms, transforms, vectors)
def test_composition_cancels_the_inner_names(c_from_b, b_from_a, point_in_a):
    through = rigid.apply(c_from_b, rigid.apply(b_from_a, point_in_a))
    assert np.allclose(rigid.apply(c_from_b @ b_from_a, point_in_a), through, atol=1e-9, rtol=0)


@given(transforms, vectors, vectors)
def test_distances_and_handedness_stay(b_from_a, p, q):
    moved = rigid.apply(b_from_a, np.stack([p, q]))
    assert np.linalg.norm(moved[0] - moved[1]) == pytest.approx(np.linalg.norm(p - q), abs=1e-9)
    assert np.linalg.det(b_from_a[:3, :3]) == pytest.approx(1, abs=1e-12)


def test_apply_takes_points_of_any_shape():
    b_from_a = rigid.transform(Rotation.from_euler("xyz", [10, -20, 30], degrees=True).as_matrix(), [1, 2, 3])
    points = np.random.default_rng(0).normal(size=(4, 5, 3))
    moved = rigid.apply(b_from_a, points)
    homogeneous = np.concatenate([points, np.ones((4, 5, 1))], axis=-1)
    assert moved.shape == points.shape
    assert np.allclose(moved, np.einsum("ij,klj->kli", b_from_a, homogeneous)[..., :3], atol=ROUNDING)


def test_a_quarter_turn_about_x_takes_y_to_z():
    # The sense of rotation of the bundle format: right-hand rule about +X.
    turned = rigid.rotation_from_vector([np.pi / 2, 0, 0]) @ [0, 1, 0]
    assert np.allclose(turned, [0, 0, 1], atol=1e-15)
