"""Keys over time against SciPy's splines and rotations, over random keys; clocks that repeat or hold."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from qsim.scene import Clock, Track
from qsim.scene.animated.tracks import Keyed, rotation_of

DRAWS = range(20)


def keys(seed: int, numbers: int) -> tuple[np.random.Generator, np.ndarray, np.ndarray]:
    """Return a generator, times [K] and values [K, numbers], K from 2 to 7."""
    rng = np.random.default_rng([seed, numbers])
    times = np.cumsum(rng.uniform(1e-3, 1, int(rng.integers(2, 8))))
    return rng, times, rng.normal(size=(len(times), numbers)) * 10 ** rng.uniform(-3, 3)


@pytest.mark.parametrize("seed", DRAWS)
def test_lines_steps_and_splines_are_those_of_scipy(seed):
    rng, times, values = keys(seed, 5)
    tangents = rng.normal(size=(2, *values.shape))
    moments = np.concatenate([rng.uniform(-1, times[-1] + 1, 31), times])
    line = Track(times, values)
    step = Track(times, values, "step")
    curve = Track(times, values, "cubic", tangents)
    for t in moments.tolist():
        inside = float(np.clip(t, times[0], times[-1]))
        size = np.abs(values).max()
        expected = [np.interp(inside, times, column) for column in values.T]
        np.testing.assert_allclose(line.at(t), expected, atol=1e-13 * size)
        assert np.array_equal(step.at(t), values[max(np.flatnonzero(times <= inside))])
        i = min(int(np.searchsorted(times, inside, side="right")) - 1, len(times) - 2)
        spline = CubicHermiteSpline(times[i : i + 2], values[i : i + 2], [tangents[1, i], tangents[0, i + 1]])
        np.testing.assert_allclose(curve.at(t), spline(inside), atol=1e-12 * size)


@pytest.mark.parametrize("seed", DRAWS)
def test_rotations_turn_uniformly_on_the_shorter_way(seed):
    rng, times, quaternions = keys(seed, 4)
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    if seed % 3 == 0:  # nearly equal, and of opposite sign
        near = quaternions[0] + 10.0 ** -rng.integers(3, 17) * quaternions[1]
        quaternions[1] = -near / np.linalg.norm(near)
    track = Track(times, quaternions)
    reference = Slerp(times, Rotation.from_quat(quaternions))
    for t in rng.uniform(times[0], times[-1], 31).tolist():
        np.testing.assert_allclose(rotation_of(track.quaternion_at(t)), reference(t).as_matrix(), atol=1e-12)
        assert np.linalg.norm(track.quaternion_at(t)) == pytest.approx(1, abs=1e-14)
    late = Rotation.from_quat(quaternions[-1]).as_matrix()
    np.testing.assert_allclose(rotation_of(track.quaternion_at(times[-1] + 1)), late, atol=1e-12)


def test_a_spline_of_rotations_has_length_one_and_a_step_does_not_turn():
    rng, times, quaternions = keys(3, 4)
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    tangents = rng.normal(size=(2, *quaternions.shape))
    curve = Track(times, quaternions, "cubic", tangents)
    step = Track(times, quaternions, "step")
    for t in rng.uniform(times[0], times[-1], 9).tolist():
        assert np.linalg.norm(curve.quaternion_at(t)) == pytest.approx(1)
        np.testing.assert_allclose(curve.quaternion_at(t), curve.at(t) / np.linalg.norm(curve.at(t)))
        assert np.abs(step.quaternion_at(t) - quaternions).max(axis=1).min() < 1e-15
    through_zero = Track(np.array([0, 1.0]), np.array([[0, 0, 0, 1.0], [0, 0, 0, -1]]), "cubic", np.zeros((2, 2, 4)))
    assert np.array_equal(through_zero.quaternion_at(0.5), [0, 0, 0, 1])


@pytest.mark.parametrize("seed", DRAWS)
def test_a_placement_scales_then_rotates_then_shifts(seed):
    rng = np.random.default_rng(seed)
    turn = Rotation.random(rng=rng)
    shift = rng.normal(size=3)
    scale = rng.normal(size=3)
    placed = Keyed(*(Track.constant(value) for value in (shift, turn.as_quat(), scale)))
    point = rng.normal(size=3)
    np.testing.assert_allclose((placed.pose(0.3) @ (*point, 1))[:3], turn.apply(scale * point) + shift, atol=1e-13)


def test_clocks_run_repeat_and_hold():
    assert Clock().at(-3.5) == -3.5
    assert Clock(2.0, 0.25).at(3.0) == 6.25
    repeated = Clock(2.0, 0.25, 0.5)
    held = Clock(2.0, 0.25, 0.5, repeat=False)
    for t in np.linspace(-2, 2, 41).tolist():
        assert repeated.at(t) == pytest.approx((0.25 + 2 * t) % 0.5 if t >= 0 else max(0.25 + 2 * t, 0.0))
        assert held.at(t) == np.clip(0.25 + 2 * t, 0, 0.5)
    assert Clock(-1.0, 0.0, 1.0).at(0.25) == 0.75  # backwards
    assert Clock(-1.0, 0.8, 1.0).at(-0.5) == 1.0  # before t = 0 no clock jumps to the other end
    assert Clock(1.0, 2.3, 1.0).at(-0.1) == pytest.approx(0.2)
    assert Clock(length=0.0).at(0.7) == 0.0  # a single key


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Track(np.zeros(2), np.zeros((2, 3))), "Track.times must increase, got 0 s and then 0 s"),
        (lambda: Track(np.zeros(2), np.zeros((3, 3))), r"times \[K\] and values \[K, N\]"),
        (lambda: Track(np.zeros(0), np.zeros((0, 3))), r"one or more keys"),
        (lambda: Track(np.array([np.nan]), np.zeros((1, 3))), "must be finite"),
        (lambda: Track(np.zeros(1), np.zeros((1, 3)), "curve"), "one of step, linear, cubic is needed"),
        (lambda: Track(np.zeros(1), np.zeros((1, 3)), "cubic"), "a cubic track needs them"),
        (lambda: Track(np.zeros(1), np.zeros((1, 3)), "step", np.zeros((2, 1, 3))), "any other has none"),
        (
            lambda: Track(np.zeros(1), np.zeros((1, 3)), "cubic", np.zeros((2, 1, 2))),
            r"Track.tangents: finite \[2, 1, 3\]",
        ),
        (lambda: Keyed(*[Track.constant((0, 0, 0))] * 3), "Keyed.rotation: 4 numbers per key are needed, got 3"),
        (lambda: Clock(float("nan")), "Clock.speed: expected a finite number"),
        (lambda: Clock(length=-1.0), "Clock.length: seconds from 0 are needed"),
    ],
)
def test_wrong_keys_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
