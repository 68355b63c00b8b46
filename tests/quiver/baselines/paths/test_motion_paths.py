"""Paths: every step against a plain slow reference over random draws, then known motions."""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter, map_coordinates
from stats import assert_mean

from quiver.baselines.paths import motion_paths as mp
from quiver.baselines.paths import moved_frames as mf
from quiver.baselines.paths import path_search as ps


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
    found = mf.box_mean(torch.from_numpy(image), radius).numpy()
    assert found == pytest.approx(np.array(expected), abs=1e-12)


def looked(image, moved):
    """One image [H, W] seen at p + moved [2, H, W], and where that lies inside."""
    path = torch.from_numpy(np.asarray(moved, np.float32))[None]
    seen, inside = mf.look(torch.from_numpy(image.astype(np.float32))[None, None], (path, torch.zeros_like(path)), (1,))
    return seen[0, 0].numpy(), inside[0, 0].numpy()


@pytest.mark.parametrize("seed", range(8))
def test_looking_is_linear_interpolation(seed):
    rng = np.random.default_rng(seed)
    height, width = (int(n) for n in rng.integers(1, 14, 2))
    image = rng.normal(size=(height, width))
    moved = rng.uniform(-6, 6, (2, height, width))
    place = np.mgrid[:height, :width] + moved
    seen, inside = looked(image, moved)
    expected = map_coordinates(image, place, order=1, mode="nearest")
    assert seen == pytest.approx(expected, abs=2e-5)
    limits = np.array([height, width])[:, None, None] - 0.5
    assert np.array_equal(inside == 1, ((place >= -0.5) & (place <= limits)).all(0))


@pytest.mark.parametrize(("scale", "speed"), [(8, mp.SPEED), (4, mp.SLOW)])
@pytest.mark.parametrize("seed", range(4))
def test_the_search_tries_every_velocity(seed, scale, speed):
    """Costs of all velocities in plain loops; the least must be the one found, or tie with it."""
    rng = np.random.default_rng(seed)
    offsets = [(0, 1), (-2, 0, 2), (-1, 0, 3), (-4, -3, 0)][seed]
    height, width = (int(n) for n in rng.integers(3, 8, 2))
    frames = rng.normal(0, 0.2, (len(offsets), height, width)).astype(np.float32)
    found = ps.search(torch.from_numpy(frames)[None], offsets, scale, speed)[0].numpy() / (ps.STEP * scale)
    most = round(speed / scale / ps.STEP)
    reference = frames[offsets.index(0)]
    steps = np.arange(-most, most + 1)
    sums, counts = np.zeros((2, len(steps), len(steps), height, width))
    for i, v in enumerate(steps):
        for j, u in enumerate(steps):
            for frame, offset in zip(frames, offsets, strict=True):
                if offset:
                    place = np.mgrid[:height, :width] + offset * ps.STEP * np.array([v, u])[:, None, None]
                    whole = np.floor(place)
                    inside = ((whole >= 0) & (whole < np.array([height, width])[:, None, None])).all(0)
                    moved = map_coordinates(frame, place, order=1, mode="nearest")
                    share = np.prod((place - whole) ** 2 + (1 - place + whole) ** 2, axis=0)
                    size = scale * np.abs(moved - reference)
                    huber = np.where(size < ps.FITS, size**2, ps.FITS * (2 * size - ps.FITS))
                    sums[i, j] += np.where(inside, huber - (1 + share), 0)
                    counts[i, j] += inside

    def block(x, radius):
        return mf.box_mean(torch.from_numpy(x).flatten(0, 1), radius).view(x.shape).numpy()

    radii = (8 // scale, 24 // scale)
    below = [block(counts, radius) for radius in radii]
    above = [block(sums, radius) * (2 * radius + 1) ** 2 for radius in radii]
    cost = np.mean([x / np.maximum(y, 1e-6) for x, y in zip(above, below, strict=True)], 0) * (len(offsets) - 1)
    outside = 1 - np.mean(below, 0) / (len(offsets) - 1)
    flat = np.where(outside <= 0.5 + 1e-4, cost + ps.OUTSIDE * outside, ps.NEVER)
    pace = scale * ps.STEP * (np.abs(steps)[:, None] + np.abs(steps))[..., None, None]
    flat = flat + ps.MOVES * (pace > 0) + ps.FASTER * np.log1p(pace)
    least = flat.min((0, 1))
    at = np.rint(found).astype(int) + most  # the parabola moves by half a step at most
    y, x = np.mgrid[:height, :width]
    beside = [
        (np.clip(at[0] + i, 0, 2 * most), np.clip(at[1] + j, 0, 2 * most)) for i in (-1, 0, 1) for j in (-1, 0, 1)
    ]
    around = [flat[down, right, y, x] for down, right in beside]
    assert np.min(around, axis=0) == pytest.approx(least, rel=1e-5, abs=1e-5)
    assert np.abs(found).max() <= most + 0.5


def test_interpolation_keeps_the_stated_share_of_the_noise():
    rng = np.random.default_rng(5)
    for _ in range(6):
        noise = rng.normal(size=(300, 300))
        move = rng.uniform(-3, 3, 2)
        moved = np.broadcast_to(move[:, None, None], (2, 300, 300))
        seen = looked(noise, moved)[0][8:-8:2, 8:-8:2]  # neighbours share pixels
        kept = float(mf.kept_noise(torch.from_numpy(moved.copy()))[0, 0])
        assert_mean(seen**2, kept, 2 * kept**2)


@pytest.mark.parametrize("level", [0.0, 3.0])
def test_noise_moves_nothing(level):
    """Still scenes stay sharp: noise alone gives about 0.8 % of the places a path, noise over a texture 0.03 %."""
    shares = []
    for seed in range(6):
        frames, still = (window((0, 0), (0, 0), noise, seed) for noise in (1.0, 0.0))
        found = {scale: frames[scale] - still[scale] + level / 40 * still[scale] for scale in mf.SCALES}
        v, a = found_paths(found, list(range(-5, 6)))
        shares.append(float(((v != 0) | (a != 0)).any(0).float().mean()))
    assert np.mean(shares) < (0.02 if level == 0 else 0.003)  # four deviations above the means of 24 other seeds


def test_corrections_converge():
    """More corrections of a texture without noise never make its paths worse, as means with a negative lobe did."""
    pyramid = window((0.4, -0.7), (0, 0), 0.05, seed=3)
    offsets = list(range(-5, 6))
    truth = torch.tensor([0.4, -0.7])[:, None, None]
    v = mf.enlarged(ps.search(pyramid[8][None], offsets, 8, mp.SPEED), pyramid[2].shape[1:])
    a = torch.zeros_like(v)
    errors = []
    for _ in range(9):
        v, a = mp.correct(pyramid[2][None], offsets, v, a, 2, 4)
        errors.append(float((v[0] - truth)[:, 12:-12, 12:-12].square().mean().sqrt()))
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
    return {scale: torch.nn.functional.avg_pool2d(full[:, None], scale)[:, 0] for scale in mf.SCALES}


def found_paths(pyramid, offsets):
    """The velocity and acceleration [2, H, W] of one window."""
    windows = {scale: frames[None] for scale, frames in pyramid.items()}
    velocity, acceleration = mp.paths(windows, offsets, windows[2], torch.ones(1, 1, *pyramid[2].shape[1:]))
    return velocity[0], acceleration[0]


def led_to(velocity, acceleration, offset):
    """Where a path leads after `offset` frames."""
    return velocity * offset + acceleration * (offset * offset / 2)


@pytest.mark.parametrize(
    ("velocity", "acceleration"),
    [((0, 0), (0, 0)), ((0.4, -0.7), (0, 0)), ((-3, 5), (0.1, 0)), ((9, -6), (0, 0)), ((0, 16), (0, -0.2))],
)
def test_paths_follow_a_moving_texture(velocity, acceleration):
    v, a = found_paths(window(velocity, acceleration, 1.0, seed=3), list(range(-5, 6)))
    inner = (slice(None), slice(12, -12), slice(12, -12))
    truth = [torch.tensor(x, dtype=torch.float32)[:, None, None] for x in (velocity, acceleration)]
    for offset in (-4, 4):
        apart = led_to(v, a, offset)[inner] - led_to(*truth, offset)
        limit = 0.2 + 0.08 * np.hypot(*velocity)  # measured: 0.06, 0.09, 0.2 and 1.2 px from still to 16 px/frame
        assert float(apart.square().sum(0).sqrt().median()) < limit, "px, after four frames"


@pytest.mark.parametrize("length", [1, 2, 3, 5])
def test_windows_may_be_short_and_one_sided(length):
    offsets = list(range(length))
    v, a = found_paths(window((1.0, 2.0), (0, 0), 0.5, seed=1, offsets=offsets), offsets)
    assert torch.isfinite(torch.stack([v, a])).all()
    if length == 1:
        assert not v.any()
    if length == 5:
        found = led_to(v, a, 4)[:, 8:-8, 8:-8].flatten(1).median(1).values
        assert found.tolist() == pytest.approx([4, 8], abs=0.3)


def test_time_has_no_direction():
    pyramid = window((2.0, -1.0), (0, 0), 1.0, seed=5)
    back = {scale: frames.flip(0) for scale, frames in pyramid.items()}
    forward, backward = (found_paths(frames, list(range(-5, 6))) for frames in (pyramid, back))
    apart = (forward[0] + backward[0]).abs()  # ties of the search may fall differently at single cells
    assert float(apart.median()) < 1e-3


@pytest.mark.parametrize("seed", range(6))
def test_paths_follow_fine_stripes(seed):
    """Stripes of 8 to 14 px vanish in cells of 8 px; slow paths find them, up to a move along the stripes."""
    rng = np.random.default_rng(seed)
    period = rng.uniform(8, 14)
    turn = rng.uniform(0, np.pi)
    speed = rng.uniform(0.7, 1.5)
    across = np.array([np.sin(turn), np.cos(turn)])
    y, x = np.mgrid[:96, :96]
    frames = []
    for k in range(-5, 6):
        phase = (across[0] * y + across[1] * x - speed * k) * (2 * np.pi / period)
        frames.append(1.5 * np.sign(np.sin(phase)) + rng.normal(size=(96, 96)))
    full = torch.tensor(np.array(frames), dtype=torch.float32)
    pyramid = {scale: torch.nn.functional.avg_pool2d(full[:, None], scale)[:, 0] for scale in mf.SCALES}
    v, _ = found_paths(pyramid, list(range(-5, 6)))
    found = np.tensordot(across, v[:, 12:-12, 12:-12].numpy(), 1)
    assert np.mean(np.abs(found - speed) < 0.15) > 0.5  # px/frame; without slow paths four of these six fail
