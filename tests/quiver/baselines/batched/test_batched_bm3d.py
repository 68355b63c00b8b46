"""BM3D in batches: equal to the BM3D that runs on a CPU, however images and tiles are taken together."""

import numpy as np
import pytest
import torch
from skimage import data

from quiver.baselines import bm3d as alone
from quiver.baselines.batched import bm3d


def images_of(rng, count, shape):
    """Parts of a photograph [B, H, W] in 0 ... 255, repeated where they are wider than it."""
    picture = data.camera().astype(float)
    corners = rng.integers(0, 300, (count, 2))
    return np.stack([np.resize(picture[y : y + shape[0], x : x + shape[1]], shape) for y, x in corners])


@pytest.mark.parametrize("seed", range(8))
def test_images_are_denoised_as_one_by_one(seed):
    """Over sizes, noise, units and offsets. Blocks at nearly one distance may change places: a few pixels differ."""
    rng = np.random.default_rng(seed)
    shape = (int(rng.integers(1, 70)), int(rng.integers(1, 90)))
    sigma = 10 ** rng.uniform(0, 2)
    unit = 10 ** rng.uniform(-3, 3)
    offset = rng.choice([0.0, -3.0])
    images = images_of(rng, 3, shape) + rng.normal(0, sigma, (3, *shape))
    given = ((images / 255 + offset) * unit).astype(np.float32)
    settings = {"sigma": float(sigma / 255 * unit), "peak": float(unit)}
    expected = np.stack([alone.denoise(image, **settings) for image in given])
    found = bm3d.denoise(torch.from_numpy(given), **settings).numpy()
    difference = np.abs(found - expected) / unit
    assert difference.max() < 2e-3
    assert np.sqrt(np.mean(difference**2)) < 5e-5
    assert np.quantile(difference, 0.9) < 2e-5


def test_memory_decides_what_is_taken_together_and_changes_nothing():
    rng = np.random.default_rng(1)
    images = torch.from_numpy(images_of(rng, 2, (61, 80)) + rng.normal(0, 20, (2, 61, 80))).float()
    whole = bm3d.denoise(images, 20.0, peak=255.0)
    for memory in (0, 3 * bm3d.TILE_BYTES, 20 * bm3d.TILE_BYTES):
        found = bm3d.denoise(images, 20.0, peak=255.0, memory=memory)
        torch.testing.assert_close(found, whole, rtol=0, atol=1e-3)


def test_without_noise_nothing_changes():
    images = torch.from_numpy(images_of(np.random.default_rng(2), 2, (20, 30))).float()
    assert torch.equal(bm3d.denoise(images, 0.0), images)


def test_short_stacks_take_their_first_blocks_alone():
    """The Haar matrix of a stack of 4 in one of 16: that of 4 in the corner, and nothing else."""
    matrices = bm3d._haar(16, torch.device("cpu"))
    for octave, matrix in enumerate(matrices):
        size = 2**octave
        torch.testing.assert_close(matrix[:size, :size], alone.haar_matrix(size))
        assert matrix.abs().sum() == matrix[:size, :size].abs().sum()
