"""Linear blend skinning against loops over vertices, and against rotations in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from qsim.scene import Clock, Joint, Morph, Oscillation, Pendulum, Skinned, Spin, Still, Track, Translation

ONE = np.ones((7, 1))


def strip(count: int = 7) -> np.ndarray:
    """Return points along -y from the origin, 0.1 m apart, with some depth."""
    k = np.arange(count)
    return np.column_stack([0.01 * k % 0.03, -0.1 * k, 0.02 * (k % 2)])


@pytest.mark.parametrize("seed", range(15))
def test_vertices_are_weighted_sums_of_chains_of_matrices(seed):
    """Random trees of joints, weights and morph targets; the reference follows one vertex after the other."""
    rng = np.random.default_rng(seed)
    count, joints, wide, targets = (int(rng.integers(1, high)) for high in (12, 7, 5, 4))
    motions = [
        Spin(rng.normal(size=3), rng.normal(), 0.3, tuple(rng.normal(size=3)))
        if rng.random() < 0.5
        else Oscillation(tuple(rng.normal(size=3)), 2.0, rng.normal())
        for _ in range(joints)
    ]
    tree = tuple(Joint(motion, int(rng.integers(-1, i)) if i else -1) for i, motion in enumerate(motions))
    rest = rng.normal(size=(count, 3))
    owners = rng.integers(0, joints, (count, wide))
    shares = rng.dirichlet(np.ones(wide), count)
    first = int(rng.integers(0, count))
    shifts = rng.normal(size=(targets, int(rng.integers(1, count - first + 1)), 3))
    weights = Track(np.array([0.0, 1.0]), rng.normal(size=(2, targets)))
    body = Skinned(rest, tree, owners, shares, (Morph(first, shifts, weights),), Clock(3.0, 0.1))
    t = float(rng.uniform(0, 0.3))
    moment = 0.1 + 3 * t

    for v, found in enumerate(body.deform(t)):
        start = rest[v].copy()
        if first <= v < first + shifts.shape[1]:
            for m in range(targets):
                weight = weights.values[0, m] + moment * (weights.values[1, m] - weights.values[0, m])
                start += weight * shifts[m, v - first]
        total = np.zeros(3)
        for owner, share in zip(owners[v].tolist(), shares[v].tolist(), strict=True):
            point = start
            at = owner
            while at >= 0:  # from the joint up to the root
                pose = motions[at].pose(moment)
                point = pose[:3, :3] @ point + pose[:3, 3]
                at = tree[at].parent
            total += share * point
        np.testing.assert_allclose(found, total, atol=1e-12 * (1 + np.abs(total).max()))


def test_one_bone_is_a_rigid_rotation_and_the_knee_follows_the_hip():
    hip = Pendulum((0, 0, 0), (0, 0, 1), 0.7, 3.0)
    knee = Pendulum((0, -0.3, 0), (0, 0, 1), 0.4, 5.0, 0.2)
    rest = strip()
    below = np.arange(7) >= 3
    leg = Skinned(rest, (Joint(hip), Joint(knee, 0)), below[:, None], ONE, carrier=Translation((1.0, 0, 0)))
    t = 0.0713
    a = 0.7 * np.sin(6 * np.pi * t)
    b = 0.4 * np.sin(10 * np.pi * t + 0.2)

    def turned(points, angle):
        c = np.cos(angle)
        s = np.sin(angle)
        return np.column_stack([c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1], points[:, 2]])

    joint = np.array([0, -0.3, 0])
    expected = turned(rest, a)
    expected[below] = turned(turned(rest[below] - joint, b) + joint, a)
    np.testing.assert_allclose(leg.deform(t), expected, atol=1e-15)
    np.testing.assert_allclose(leg.pose(t)[:3, 3], (t, 0, 0))
    assert leg.velocity(t)[0].tolist() == [1, 0, 0]


def test_halves_of_opposite_turns_shrink_by_the_cosine():
    """The known law of linear blending: two turns by +a and -a about one axis give cos(a) across it."""
    rest = strip()
    pair = tuple(Joint(Spin((0, 0, 1), rate)) for rate in (2.0, -2.0))
    bent = Skinned(rest, pair, np.tile([0, 1], (7, 1)), np.full((7, 2), 0.5)).deform(0.4)
    np.testing.assert_allclose(bent[:, :2], rest[:, :2] * np.cos(0.8), atol=1e-15)
    np.testing.assert_array_equal(bent[:, 2], rest[:, 2])


def test_shares_sum_to_one_and_times_come_in_any_order():
    shares = np.tile([0.3, 0.7 + 4e-7], (7, 1))
    moving = (Joint(Still()), Joint(Translation((1.0, 0, 0))))
    body = Skinned(strip(), moving, np.tile([0, 1], (7, 1)), shares)
    np.testing.assert_allclose(body.deform(1.0)[:, 0], strip()[:, 0] + 0.7, atol=1e-6)
    np.testing.assert_allclose(body.shares.sum(axis=1), 1, atol=1e-15)
    times = (0.3, -0.1, 7.0)
    forward = [body.deform(t) for t in times]
    assert all(np.array_equal(body.deform(t), found) for t, found in zip(times[::-1], forward[::-1], strict=True))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rest": np.zeros((7, 2))}, r"Skinned.rest: vertices \[V, 3\] are needed, got \(7, 2\)"),
        ({"joints": (Joint(Still(), 0),)}, r"Skinned.joints\[0\]: its parent must come before it, got 0"),
        ({"owners": np.full((7, 1), 1)}, r"vertex 0 has the joints \[1\]; there are 1, from 0"),
        ({"owners": np.full((7, 1), -1)}, "vertex 0 has the joints"),
        ({"owners": np.zeros((6, 1), int)}, r"joints and weights of shape \[7, n\] are needed"),
        ({"shares": 0.9 * ONE}, r"the weights of vertex 0 are \[0.9\]; they must be 0 or more and sum to 1"),
        ({"shares": np.where(np.arange(7)[:, None] == 4, np.nan, 1.0)}, r"weights: nan at index \(4, 0\)"),
        ({"morphs": (Morph(6, np.zeros((1, 2, 3)), Track.constant([0])),)}, "of existing vertices with M weights"),
        ({"morphs": (Morph(0, np.zeros((2, 2, 3)), Track.constant([0])),)}, "from vertex 0 and 1"),
    ],
)
def test_wrong_skins_are_named(changes, message):
    right = {"rest": strip(), "joints": (Joint(Still()),), "owners": np.zeros((7, 1), int), "shares": ONE}
    Skinned(**right)
    with pytest.raises(ValueError, match=message):
        Skinned(**(right | changes))


@pytest.mark.parametrize("speed", [1e7, 1e308])
def test_vertices_beyond_all_measure_are_refused(speed):
    far = Joint(Translation((speed, 0, 0)))
    with pytest.raises(ValueError, match="vertices farther away than 1e\\+06 m at 1 s"):
        Skinned(strip(), (far, Joint(far.motion, 0)), np.ones((7, 1), int), ONE).deform(1.0)
