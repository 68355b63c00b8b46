"""Tests the velocity search: known motion, the choice of a naive loop, rest in flat regions, small sizes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from stats import assert_mean

from quiver.model import plane_sweep
from quiver.model.plane_sweep import aligned, disagreement, paths

GRID = 2 * plane_sweep.STEP  # px/frame at full size


def sliding(
    velocity: tuple[float, float], size: tuple[int, int] = (40, 48), acceleration: tuple[float, float] = (0.0, 0.0)
) -> torch.Tensor:
    """Return [1, 11, h, w]: waves of 8 to 16 px that move by `velocity` (x, y) px per frame, values 0.1 to 0.9."""
    rng = np.random.default_rng(5)
    y, x = np.mgrid[: size[0], : size[1]]
    angles, lengths, phases = rng.uniform(0, 2 * np.pi, 9), rng.uniform(8, 16, 9), rng.uniform(0, 2 * np.pi, 9)
    pictures = []
    for k in range(-5, 6):
        dx, dy = (k * v + k * k / 2 * a for v, a in zip(velocity, acceleration, strict=True))
        along = [np.cos(a) * (x - dx) + np.sin(a) * (y - dy) for a in angles]
        waves = [np.sin(2 * np.pi * s / n + p) for s, n, p in zip(along, lengths, phases, strict=True)]
        pictures.append(0.5 + 0.4 * np.mean(waves, axis=0))
    return torch.tensor(np.stack(pictures)[None], dtype=torch.float32)


@pytest.mark.parametrize("velocity", [(0.0, 0.0), (1.0, 0.0), (-0.5, 2.0), (1.3, -0.8), (3.0, 2.5)])
def test_known_motion_is_found(velocity):
    """Away from the border the error is below half a step of the grid, mostly below a tenth. The frames then agree."""
    window = sliding(velocity, (56, 64))
    found = paths(window, 7.0)
    inner = (..., slice(18, -18), slice(18, -18))
    error = (found[0] - torch.tensor(velocity).view(1, 2, 1, 1))[inner]
    assert error.abs().max() <= 0.5 * GRID
    assert error.abs().quantile(0.9) <= 0.1 * GRID
    before, after = (disagreement(frames)[inner].sqrt().mean() for frames in (window, aligned(window, *found)))
    if velocity != (0.0, 0.0):
        assert after < 0.3 * before


@pytest.mark.parametrize("acceleration", [(0.2, 0.0), (-0.1, 0.15)])
def test_known_acceleration_is_found(acceleration):
    """The corrections find more than half of it at most pixels, and the frames agree far better than before."""
    window = sliding((1.0, -0.5), (64, 72), acceleration)
    velocity, found = paths(window, 7.0)
    inner = (..., slice(18, -18), slice(18, -18))
    error = (found - torch.tensor(acceleration).view(1, 2, 1, 1))[inner].norm(dim=1)
    assert error.quantile(0.75) <= 0.5 * np.hypot(*acceleration)
    straight, bent = (aligned(window, velocity, a) for a in (torch.zeros_like(found), found))
    assert disagreement(bent)[inner].mean() < 0.2 * disagreement(straight)[inner].mean()


def test_the_grid_is_searched_as_the_naive_loop_does():
    """A loop over pixels in NumPy, float64: weights, shifts by pixels, box means and the choice are the same."""
    window = sliding((1.0, -0.5), (12, 14))[0].double().numpy()[1:10]
    weights = np.exp(-0.5 * (np.arange(-4, 5) / plane_sweep.SIGMA) ** 2)
    weights /= weights.sum()
    grid = [(vx, vy) for vy in np.arange(-2, 3) / 2 for vx in np.arange(-2, 3) / 2]
    h, w = window.shape[1:]
    costs = np.empty((len(grid), h // 2, w // 2))
    for i, (vx, vy) in enumerate(grid):
        moved = np.empty_like(window)
        for t, k in enumerate(range(-4, 5)):
            rows = np.clip(np.arange(h) + round(k * vy), 0, h - 1)
            moved[t] = window[t][rows][:, np.clip(np.arange(w) + round(k * vx), 0, w - 1)]
        variance = np.tensordot(weights, moved**2, 1) - np.tensordot(weights, moved, 1) ** 2
        for r in range(h // 2):
            for c in range(w // 2):
                box = variance[max(0, 2 * r - 3) : 2 * r + 5, max(0, 2 * c - 3) : 2 * c + 5]
                costs[i, r, c] = (box.mean() + plane_sweep.FLOOR) * (1 + plane_sweep.PREFERENCE * np.hypot(vx, vy))
    frames = torch.tensor(window, dtype=torch.float32)[None]
    found = plane_sweep.best_of_grid(frames, torch.tensor(weights, dtype=torch.float32), 1.0)[0, :, ::2, ::2].numpy()
    chosen = [grid.index((float(x), float(y))) for x, y in found.reshape(2, -1).T]
    paid = np.take_along_axis(costs.reshape(len(grid), -1), np.array([chosen]), 0)[0]
    np.testing.assert_allclose(paid, costs.min(0).ravel(), rtol=1e-3, atol=1e-7)  # the best, or its equal in float32


def test_noise_is_averaged_along_the_way():
    """With photon noise, the mean over time of aligned frames is unbiased and far closer to the truth."""
    clean = sliding((1.5, -1.0), (64, 64))
    photons = torch.from_numpy(np.random.default_rng(1).poisson(6.0 * clean.numpy()).astype(np.float32)) / 6
    found = paths(photons, 7.0)
    inner = (..., slice(18, -18), slice(18, -18))
    truth = clean[:, 5][inner]
    plain, drawn = ((f.mean(1)[inner] - truth) for f in (photons, aligned(photons, *found)))
    noise = truth.mean() / 6 / 11  # variance of a mean of eleven Poisson counts / 6
    assert plain.square().mean() > 1.3 * noise, "without motion compensation the pattern is smeared"
    assert drawn.square().mean() < noise, "bilinear interpolation only lowers it"
    assert_mean(drawn.numpy().ravel(), 0.0, float(noise))


@pytest.mark.parametrize("shape", [(1, 11, 4, 4), (2, 3, 4, 8), (1, 1, 6, 5), (1, 11, 5, 33)])
def test_hard_sizes_and_constant_frames_rest(shape):
    frames = torch.full(shape, 0.3)
    left, found = disagreement(frames), paths(frames, 7.0)
    assert left.shape == (shape[0], 1, *shape[2:])
    assert left.abs().max() < 2e-6
    for field in found:
        assert field.shape == (shape[0], 2, *shape[2:])
        assert field.abs().max() < 1e-4
    assert bool(aligned(torch.rand(shape), *found).isfinite().all())


def test_mirrored_frames_move_mirrored():
    window = sliding((1.0, 0.5))
    found, mirrored, backwards = (paths(frames, 4.0)[0] for frames in (window, window.flip(3), window.flip(1)))
    inner = (..., slice(14, -14), slice(14, -14))
    for other, sign in ((mirrored.flip(3), (-1, 1)), (backwards, (-1, -1))):
        assert (other * torch.tensor(sign).view(1, 2, 1, 1) - found)[inner].abs().max() <= 0.1 * GRID


def test_aligning_passes_gradients_to_the_frames():
    window = sliding((1.0, 0.0), (8, 10)).requires_grad_()
    found = paths(window, 2.0)
    assert not found[0].requires_grad
    aligned(window, *found).sum().backward()
    assert window.grad is not None
    assert window.grad.isfinite().all()
    np.testing.assert_allclose(float(window.grad.sum()), window.numel(), rtol=1e-5)  # bilinear weights sum to one
    assert F.mse_loss(aligned(window, *torch.zeros(2, 1, 2, 8, 10)), window) < 1e-12


@pytest.mark.parametrize(("side", "stride"), [(1, 1), (3, 1), (5, 1), (9, 1), (15, 1), (8, 2)])
@pytest.mark.parametrize("size", [(1, 1), (2, 7), (31, 40)])
def test_means_are_those_of_what_exists(side, stride, size):
    image = torch.rand(2, 1, *size, dtype=torch.float64)
    means = plane_sweep.means_at(image, side, stride)
    before = (side - 1) // 2
    for i in range(means.shape[2]):
        for j in range(means.shape[3]):
            y, x = stride * i - before, stride * j - before
            around = image[..., max(y, 0) : y + side, max(x, 0) : x + side]
            assert torch.allclose(means[..., i, j], around.mean(dim=(2, 3)), rtol=1e-12)
    assert means.shape[2:] == (-(-size[0] // stride), -(-size[1] // stride))
