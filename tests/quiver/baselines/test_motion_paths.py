"""Paths: every step against a plain slow reference over random draws, then known motions."""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter, map_coordinates

from quiver.baselines import motion_paths as mp


@pytest.mark.parametrize("seed", range(8))
def test_box_means_are_means(seed):
    rng = np.random.default_rng(seed)
    count, height, width, radius = (int(n) for n in rng.integers((1, 1, 1, 0), (4, 12, 12, 10)))
    image = rng.normal(size=(count, height, width))
    grown = np.pad(image, [(0, 0), (radius, radius), (radius, radius)], mode="edge")
    side = 2 * radius + 1
    expected = [
        [[one[y : y + side, x : x + side].mean() for x in range(width)] for y in range(height)] for one in grown
    ]
    found = mp.box_mean(torch.from_numpy(image), radius).numpy()
    assert found == pytest.approx(np.array(expected), abs=1e-12)


@pytest.mark.parametrize("seed", range(8))
def test_looking_is_linear_interpolation(seed):
    rng = np.random.default_rng(seed)
    height, width = (int(n) for n in rng.integers(1, 14, 2))
    image, moved = rng.normal(size=(height, width)), rng.uniform(-6, 6, (2, height, width))
    place = np.mgrid[:height, :width] + moved
    seen, inside = mp.look(torch.from_numpy(image), torch.from_numpy(moved))
    expected = map_coordinates(image, place, order=1, mode="nearest")
    assert seen.numpy() == pytest.approx(expected, abs=1e-6)
    limits = np.array([height, width])[:, None, None] - 0.5
    assert np.array_equal(inside.numpy() == 1, ((place >= -0.5) & (place <= limits)).all(0))


@pytest.mark.parametrize("seed", range(4))
def test_the_search_tries_every_velocity(seed):
    """Costs of all velocities in plain loops; the least must be the one found, or tie with it."""
    rng = np.random.default_rng(seed)
    offsets = [(0, 1), (-2, 0, 2), (-1, 0, 3), (-4, -3, 0)][seed]
    height, width = (int(n) for n in rng.integers(3, 8, 2))
    frames = rng.normal(size=(len(offsets), height, width)).astype(np.float32)
    found = mp.search(torch.from_numpy(frames), offsets).numpy() / (mp.STEP * 8)
    most, noise, reference = round(mp.SPEED / 8 / mp.STEP), 1 / 8, frames[offsets.index(0)]
    steps = np.arange(-most, most + 1)
    sums, counts = np.zeros((2, len(steps), len(steps), height, width))
    for i, v in enumerate(steps):
        for j, u in enumerate(steps):
            for frame, offset in zip(frames, offsets, strict=True):
                if offset:
                    place = np.mgrid[:height, :width] + offset * mp.STEP * np.array([v, u])[:, None, None]
                    whole = np.floor(place)
                    inside = ((whole >= 0) & (whole < np.array([height, width])[:, None, None])).all(0)
                    moved = map_coordinates(frame, place, order=1, mode="nearest")
                    sums[i, j] += np.where(inside, np.abs(moved - reference), 0)
                    counts[i, j] += inside

    def blocks(x):
        flat = torch.from_numpy(x).flatten(0, 1)
        return (mp.box_mean(flat, 1) + mp.box_mean(flat, 3)).view(x.shape).numpy() / 2

    above, below = blocks(sums), blocks(counts)
    outside = 1 - below / (len(offsets) - 1)
    allowed = outside <= 0.5 + 1e-4
    flat = np.where(allowed, above / np.maximum(below, 1e-6) * (1 + mp.OUTSIDE * outside), mp.NEVER)
    flat = flat + mp.PREFERENCE * noise * mp.STEP * (np.abs(steps)[:, None] + np.abs(steps))[..., None, None]
    least = flat.min((0, 1))
    at = np.rint(found).astype(int) + most  # the parabola moves by half a step at most
    y, x = np.mgrid[:height, :width]
    beside = [
        (np.clip(at[0] + i, 0, 2 * most), np.clip(at[1] + j, 0, 2 * most)) for i in (-1, 0, 1) for j in (-1, 0, 1)
    ]
    around = [flat[down, right, y, x] for down, right in beside]
    assert np.min(around, axis=0) == pytest.approx(least, rel=1e-5, abs=1e-5)
    assert np.abs(found).max() <= most + 0.5


def test_corrections_converge():
    """More corrections of a texture without noise never make its paths worse, as means with a negative lobe did."""
    pyramid, offsets = window((0.4, -0.7), (0, 0), 0.05, seed=3), list(range(-5, 6))
    truth = torch.tensor([0.4, -0.7])[:, None, None]
    v = mp.enlarged(mp.search(pyramid[8], offsets), pyramid[2].shape[1:])
    a, errors = torch.zeros_like(v), []
    for _ in range(9):
        v, a = mp.correct(pyramid[2], offsets, v, a, 2, 4)
        errors.append(float((v - truth)[:, 12:-12, 12:-12].square().mean().sqrt()))
    assert errors[-1] < 1.05 * min(errors)
    assert errors[-1] < 0.05


def window(velocity, acceleration, noise, seed, offsets=range(-5, 6), side=96):
    """A moving texture at all scales {scale: [K, h, w]}, in units of the noise of a pixel times `noise`."""
    rng = np.random.default_rng(seed)
    texture = 40 * gaussian_filter(rng.normal(size=(512, 512)), 3)
    y, x = np.mgrid[:side, :side] + 200.0
    frames = []
    for k in offsets:
        dy, dx = (v * k + a * k * k / 2 for v, a in zip(velocity, acceleration, strict=True))
        frames.append(map_coordinates(texture, [y - dy, x - dx], order=3) + noise * rng.normal(size=(side, side)))
    full = torch.tensor(np.array(frames), dtype=torch.float32)
    return {scale: torch.nn.functional.avg_pool2d(full[:, None], scale)[:, 0] for scale in mp.SCALES}


@pytest.mark.parametrize(
    ("velocity", "acceleration"),
    [((0, 0), (0, 0)), ((0.4, -0.7), (0, 0)), ((-3, 5), (0.1, 0)), ((9, -6), (0, 0)), ((0, 16), (0, -0.2))],
)
def test_paths_follow_a_moving_texture(velocity, acceleration):
    v, a = mp.paths(window(velocity, acceleration, 1.0, seed=3), list(range(-5, 6)))
    inner = (slice(None), slice(12, -12), slice(12, -12))
    truth = [torch.tensor(x, dtype=torch.float32)[:, None, None] for x in (velocity, acceleration)]
    for offset in (-4, 4):
        apart = mp.displacement(v, a, offset)[inner] - mp.displacement(*truth, offset)
        limit = 0.2 + 0.08 * np.hypot(*velocity)  # measured: 0.06, 0.09, 0.2 and 1.2 px from still to 16 px/frame
        assert float(apart.square().sum(0).sqrt().median()) < limit, "px, after four frames"


@pytest.mark.parametrize("length", [1, 2, 3, 5])
def test_windows_may_be_short_and_one_sided(length):
    offsets = list(range(length))
    v, a = mp.paths(window((1.0, 2.0), (0, 0), 0.5, seed=1, offsets=offsets), offsets)
    assert torch.isfinite(torch.stack([v, a])).all()
    if length == 1:
        assert not v.any()
    if length == 5:
        found = mp.displacement(v, a, 4)[:, 8:-8, 8:-8].flatten(1).median(1).values
        assert found.tolist() == pytest.approx([4, 8], abs=0.3)


def test_time_has_no_direction():
    pyramid = window((2.0, -1.0), (0, 0), 1.0, seed=5)
    back = {scale: frames.flip(0) for scale, frames in pyramid.items()}
    forward, backward = (mp.paths(frames, list(range(-5, 6))) for frames in (pyramid, back))
    apart = (forward[0] + backward[0]).abs()  # ties of the search may fall differently at single cells
    assert float(apart.median()) < 1e-3
