"""Rotations: exponential, logarithm and left Jacobian against each other."""

from __future__ import annotations

import numpy as np
import pytest

from qsim.scene import (
    Still,
)
from qsim.scene.rotation import exponential, left_jacobian, logarithm, rotation_between, rotation_matrix


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-5, 0.5, np.pi - 1e-7, np.pi])
def test_logarithm_undoes_the_exponential(angle):
    for axis in np.random.default_rng(2).normal(size=(8, 3)):
        turn = angle * axis / np.linalg.norm(axis)
        again = logarithm(exponential(turn))
        assert np.linalg.norm(again) == pytest.approx(angle, abs=1e-9)
        np.testing.assert_allclose(exponential(again), exponential(turn), atol=1e-9)  # half turns have two axes
        np.testing.assert_allclose(exponential(turn), rotation_matrix(axis, angle), atol=1e-12)


def test_left_jacobian_is_continuous_across_its_series():
    turn = np.array([0.3, -0.2, 0.9]) / np.linalg.norm([0.3, -0.2, 0.9])
    np.testing.assert_allclose(left_jacobian(0.99e-4 * turn), left_jacobian(1.01e-4 * turn), atol=2e-6)
    np.testing.assert_allclose(left_jacobian(turn) @ turn, turn)  # turning on about the same axis


def test_rotations_between_directions_and_of_bodies_at_rest():
    rng = np.random.default_rng(3)
    pairs = [*rng.normal(size=(5, 2, 3)), np.array([[0, 0, 2.0], [0, 0, -1.0]]), np.array([[1.0, 0, 0], [3.0, 0, 0]])]
    for start, end in pairs:
        turned = rotation_between(start, end) @ start / np.linalg.norm(start)
        np.testing.assert_allclose(turned, end / np.linalg.norm(end), atol=1e-12)
    turn = rotation_matrix((1.0, 2.0, -0.5), 0.6)
    np.testing.assert_allclose(Still.turned(turn, (1, 2, 3)).pose(0.0)[:3, :3], turn, atol=1e-15)
