"""Motions: velocities are the derivatives of poses, at any time in any order; impossible parameters are refused."""

from __future__ import annotations

import numpy as np
import pytest

from qsim.scene import (
    Ballistic,
    Composition,
    Flag,
    Joint,
    Keyframes,
    Motion,
    Oscillation,
    Pendulum,
    Ripple,
    Shake,
    Skinned,
    Spin,
    Still,
    Translation,
    Wave,
)
from qsim.scene.motion import GRAVITY
from qsim.scene.rotation import exponential, logarithm
from qsim.scene.shapes import sheet

TURNING = Spin((1, 2, -1), 30.0, 0.4, center=(0.1, -0.2, 0.3))
FLYING = Ballistic((0.1, 0.2, 0.3), (1.0, 2.0, -0.5), axis=(1, 1, 0), rate=-25.0, phase=1.0)
KEYS = Keyframes(
    (0.0, 0.3, 0.5, 1.1),
    ((0, 0, 0), (1, 0, 0.5), (1, 2, 0), (-1, 0, 0)),
    ((0, 0, 0), (0, 1.0, 0), (0.5, -0.5, 2.0), (3.1, 0, 0)),
)
SHAKING = Shake(
    (Wave((0.05, 0.3, -0.02), 11.0, 0.3), Wave((0.2, 0, 0.1), 7.0)), (Wave((0.01, 0.02, 0), 5.0, 1.0),), (0.2, 0, -0.4)
)
REST = sheet(0.4, 0.2, 7, 5).vertices + np.array([0.2, 0, 0])
FLAG = Flag(REST, (Ripple(0.05, 0.3, 4.0, 3.0, 0.5), Ripple(0.02, 0.11, -7.0)), FLYING)
SKINNED = Skinned(REST, (Joint(TURNING),), np.zeros((len(REST), 1), int), np.ones((len(REST), 1)))
MOTIONS: dict[str, Motion] = {
    "still": Still((1, 2, 3), (0.1, -0.2, 0.3)),
    "translation": Translation((1.0, -2.0, 0.5), (0.1, 0, 0)),
    "spin": TURNING,
    "ballistic": FLYING,
    "pendulum": Pendulum((0.0, 1.0, 0.2), (0, 0.2, 1), 0.7, 3.0, 0.2),
    "oscillation": Oscillation((0.1, 0.2, -0.1), 8.0, 0.3, (1, 1, 1)),
    "shake": SHAKING,
    "shake without waves": Shake(),
    "keyframes": KEYS,
    "keyframes without turns": Keyframes(KEYS.times, KEYS.positions),
    "composition": FLYING @ TURNING,
    "three deep": Translation((0, 1, 0)) @ SHAKING @ KEYS,
    "flag": FLAG,
}
TIMES = (-0.07, 0.0, 0.013, 0.21, 0.47, 0.9)
STEP = 1e-6  # s: central differences err by step^2 * third derivative, below 1e-6 here


@pytest.mark.parametrize("name", MOTIONS)
@pytest.mark.parametrize("t", [t + 1e-4 for t in TIMES])
def test_velocity_is_the_derivative_of_the_pose(name, t):
    motion = MOTIONS[name]
    linear, angular = motion.velocity(t)
    before = motion.pose(t - STEP)
    after = motion.pose(t + STEP)
    np.testing.assert_allclose(linear, (after - before)[:3, 3] / (2 * STEP), atol=2e-6 * (1 + np.abs(linear).max()))
    turned = logarithm(after[:3, :3] @ before[:3, :3].T) / (2 * STEP)
    np.testing.assert_allclose(angular, turned, atol=2e-6 * (1 + np.abs(angular).max()))


@pytest.mark.parametrize("name", MOTIONS)
def test_every_pose_is_rigid_and_its_points_move_as_stated(name):
    motion = MOTIONS[name]
    points = np.random.default_rng(1).normal(size=(5, 3))
    for t in (0.0301, 0.2201):
        pose = motion.pose(t)
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
        assert pose[3].tolist() == [0, 0, 0, 1]
        ends = [points @ motion.pose(t + d)[:3, :3].T + motion.pose(t + d)[:3, 3] for d in (-STEP, STEP)]
        linear, angular = motion.velocity(t)
        speed = linear + np.cross(angular, points @ pose[:3, :3].T)  # v + w x (R p)
        np.testing.assert_allclose(speed, (ends[1] - ends[0]) / (2 * STEP), atol=5e-6 * (1 + np.abs(speed).max()))


@pytest.mark.parametrize("name", MOTIONS)
def test_poses_are_continuous_and_independent_of_the_order_of_evaluation(name):
    motion = MOTIONS[name]
    times = np.linspace(-0.1, 1.2, 521)  # 2.5 milliseconds apart
    forward = np.array([motion.pose(t) for t in times])
    fastest = max(np.abs(motion.velocity(t)).max() for t in times)
    assert np.abs(np.diff(forward, axis=0)).max() <= 2 * fastest * (times[1] - times[0]) + 1e-12
    backward = np.array([motion.pose(t) for t in times[::-1]])[::-1]
    assert np.array_equal(forward, backward)


def test_closed_forms():
    np.testing.assert_allclose(Translation((1, 2, 3), (4, 5, 6)).pose(2.0)[:3, 3], (6, 9, 12))
    quarter = Spin((0, 0, 1), np.pi / 2, center=(1, 0, 0)).pose(1.0)
    np.testing.assert_allclose(quarter @ (2, 0, 0, 1), (1, 1, 0, 1), atol=1e-15)  # counter-clockwise about (1, 0)
    np.testing.assert_allclose(quarter @ (1, 0, 0, 1), (1, 0, 0, 1), atol=1e-15)
    fallen = Ballistic((0, 10, 0), (3, 0, 0)).pose(1.0)[:3, 3]
    np.testing.assert_allclose(fallen, (3, 10 + GRAVITY[1] / 2, 0))
    swing = Pendulum((0, 1, 0), (0, 0, 1), 0.5, 2.0)
    bob = np.array((0.0, 0.0, 0.0, 1.0))  # hangs one metre under the pivot
    assert np.linalg.norm((swing.pose(0.03) @ bob)[:3] - (0, 1, 0)) == pytest.approx(1)
    np.testing.assert_allclose((swing.pose(0.125) @ bob)[:2], (np.sin(0.5), 1 - np.cos(0.5)))  # a quarter period
    np.testing.assert_allclose(swing.pose(0.5), swing.pose(0.0), atol=1e-12)
    np.testing.assert_allclose(Oscillation((0, 2, 0), 5.0).pose(0.05)[:3, 3], (0, 2, 0))


def test_composition_multiplies_poses_and_is_associative():
    t = 0.17
    a = FLYING
    b = TURNING
    c = SHAKING
    np.testing.assert_allclose((a @ b).pose(t), a.pose(t) @ b.pose(t))
    np.testing.assert_allclose(((a @ b) @ c).pose(t), (a @ (b @ c)).pose(t))
    for left, right in zip(((a @ b) @ c).velocity(t), (a @ (b @ c)).velocity(t), strict=True):
        np.testing.assert_allclose(left, right)
    assert isinstance(a @ b, Composition)
    np.testing.assert_allclose((a @ Still()).pose(t), a.pose(t))


@pytest.mark.parametrize("deforming", [FLAG, SKINNED], ids=["flag", "skinned"])
def test_a_composition_of_a_motion_that_deforms_is_refused(deforming):
    name = type(deforming).__name__
    for compose in (lambda: FLYING @ deforming, lambda: deforming @ FLYING):
        with pytest.raises(ValueError, match=rf"{name} deforms a mesh, .* move it by {name}\(..., carrier=...\)"):
            compose()


def test_keyframes_pass_their_keys_and_rest_outside():
    for t, place, turn in zip(KEYS.times, KEYS.positions, KEYS.turns, strict=True):
        np.testing.assert_allclose(KEYS.pose(t)[:3, 3], place, atol=1e-12)
        np.testing.assert_allclose(KEYS.pose(t)[:3, :3], exponential(np.asarray(turn)), atol=1e-12)
    assert np.array_equal(KEYS.pose(-1.0), KEYS.pose(0.0))
    assert np.array_equal(KEYS.pose(9.0), KEYS.pose(1.1))
    assert not np.any(KEYS.velocity(9.0))
    assert not np.any(KEYS.velocity(-0.1))


def test_keyframes_rotate_uniformly_and_their_paths_have_no_kink():
    for key in KEYS.times[1:-1]:
        before = KEYS.velocity(key - 1e-9)[0]
        after = KEYS.velocity(key + 1e-9)[0]
        np.testing.assert_allclose(before, after, atol=1e-6)
    np.testing.assert_allclose(KEYS.velocity(0.31)[1], KEYS.velocity(0.49)[1])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Spin((0, 0, 0), 1.0), r"Spin.axis: an axis of rotation must not be \(0, 0, 0\)"),
        (lambda: Ballistic((0, 0, 0), (1, 0, 0), axis=(0, 0, 0)), "Ballistic.axis"),
        (lambda: Pendulum((0, 0, 0), (0, 0, 0), 1.0, 1.0), "Pendulum.axis"),
        (lambda: Translation((1.0, np.nan, 0.0)), "Translation.speed: expected three finite numbers"),
        (lambda: Translation((1.0, 2.0)), "Translation.speed: expected three finite numbers"),
        (lambda: Still((0, 0, np.inf)), "Still.position"),
        (lambda: Spin((0, 0, 1), np.nan), "Spin.rate: expected a finite number, got nan"),
        (lambda: Oscillation((1, 0, 0), np.inf), "Oscillation.frequency"),
        (lambda: Wave((1, 0, 0), np.nan), "Wave.frequency"),
        (lambda: Keyframes((0.0,), ((0, 0, 0),)), "needs two or more times"),
        (lambda: Keyframes((0.0, 1.0), ((0, 0, 0),)), "2 times, 1 positions"),
        (lambda: Keyframes((0.0, 0.0), ((0, 0, 0), (1, 0, 0))), "must be finite and increase"),
        (lambda: Keyframes((0.0, np.nan), ((0, 0, 0), (1, 0, 0))), "must be finite and increase"),
        (lambda: Keyframes((0.0, 1.0), ((0, 0, 0), (1, 0, np.nan))), "three finite numbers"),
        (lambda: Keyframes((0.0, 1.0), ((0, 0, 0), (1, 0, 0)), ((0, 0, 0),)), "1 turns"),
        (lambda: Ripple(0.1, 0.0, 1.0), "Ripple.wavelength: a positive length"),
        (lambda: Flag(np.zeros((4, 3)), ()), "Flag.rest"),
        (lambda: Flag(np.zeros((4, 2)), ()), "Flag.rest"),
    ],
)
def test_impossible_parameters_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
