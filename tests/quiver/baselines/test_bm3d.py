"""BM3D: laws of the filter, and its quality on two photographs against the reference package."""

import numpy as np
import pytest
import torch
from skimage import data

from quiver.baselines import bm3d


def psnr(image, truth):
    return 10 * np.log10(255**2 / np.mean((image - truth) ** 2))


def noisy(truth, sigma, seed=0):
    return truth + np.random.default_rng(seed).normal(0, sigma, truth.shape)


def photograph(name):
    return getattr(data, name)().astype(float)


def test_transforms_are_what_they_are_called():
    """The DCT and Haar matrices are orthonormal; the wavelet has rows of unit length and one constant row."""
    for matrix in (bm3d.dct_matrix(), *(bm3d.haar_matrix(2**k) for k in range(6))):
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(len(matrix)), atol=1e-6)
    wavelet = bm3d.wavelet_matrix().numpy()
    np.testing.assert_allclose(np.linalg.norm(wavelet, axis=1), 1, atol=1e-6)
    flat = wavelet @ np.ones(64)
    assert abs(flat[0]) > 1
    np.testing.assert_allclose(flat[1:], 0, atol=1e-5)
    ramp = wavelet @ np.tile(np.arange(8.0), 8)  # five vanishing moments would need a longer block: the edge wraps
    assert np.count_nonzero(np.abs(ramp) > 1e-4) < 9


def test_matching_is_an_exhaustive_search():
    """Every reference block of a small image: its stack is the nearest blocks of its search window, nearest first."""
    image = torch.from_numpy(np.random.default_rng(3).normal(0, 30, (26, 41)).astype(np.float32))
    table = bm3d.block_table(image)
    _, _, _, width = bm3d.table_size(image.shape)
    blocks = image.unfold(0, 8, 1).unfold(1, 8, 1)
    seen = set()
    for position in bm3d.similar_blocks(table, image.shape, 16, 4000.0):
        for stack in position:
            at = [(int(p) // width - bm3d.RADIUS, int(p) % width - bm3d.RADIUS) for p in stack]
            seen.add(at[0])
            y, x = at[0]
            rows = range(max(0, y - 19), min(19, y + 20))
            columns = range(max(0, x - 19), min(34, x + 20))
            window = {(r, c): float((blocks[r, c] - blocks[y, x]).square().sum()) for r in rows for c in columns}
            close = sorted(d for d in window.values() if d <= 4000 * 64)
            assert len(stack) == min(16, 2 ** int(np.log2(len(close))))
            np.testing.assert_allclose([window[p] for p in at], close[: len(stack)], rtol=1e-3, atol=2)
    assert seen == {(y, x) for y in range(0, 19, 3) for x in range(0, 34, 3)}


@pytest.mark.parametrize("shape", [(1, 1), (3, 200), (8, 8), (37, 61)])
def test_any_size_and_a_constant_stays_constant(shape):
    """Without structure there is nothing to filter, at the border neither."""
    restored = bm3d.denoise(np.full(shape, 0.4), 0.1)
    assert restored.shape == shape
    np.testing.assert_allclose(restored, 0.4, rtol=1e-5)


def test_no_noise_changes_nothing_and_little_noise_little():
    image = photograph("camera")[100:140, 200:250]
    np.testing.assert_array_equal(bm3d.denoise(image, 0.0, peak=255.0), image.astype(np.float32))
    assert np.abs(bm3d.denoise(image, 0.05, peak=255.0) - image).max() < 0.2


def test_units_and_offset_do_not_matter():
    """The same picture in other units, and on another offset: peak carries the scale, means are never shrunk."""
    image = noisy(photograph("camera")[100:164, 200:280], 20)
    grey = bm3d.denoise(image, 20.0, peak=255.0)
    np.testing.assert_allclose(bm3d.denoise(image / 1000, 0.02, peak=0.255) * 1000, grey, atol=0.01)
    np.testing.assert_allclose(bm3d.denoise(image + 300, 20.0, peak=255.0) - 300, grey, atol=0.5)


def test_a_periodic_texture_is_averaged_over_its_repetitions():
    """Stripes repeat exactly: 16 or 32 blocks average, and noise of 25 falls by far more than a local mean could do."""
    stripes = np.tile(np.where(np.arange(96) % 12 < 6, 90.0, 160.0), (96, 1))
    restored = bm3d.denoise(noisy(stripes, 25), 25.0, peak=255.0)
    assert np.sqrt(np.mean((restored - stripes) ** 2)) < 5


RECORDED = {  # PSNR of the package bm3d 4.0.3 (default profile) on exactly these noisy images, measured once
    ("camera", 25): 29.910,
    ("camera", 50): 27.804,
    ("coins", 25): 28.615,
    ("coins", 50): 25.774,
}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "sigma"), RECORDED)
def test_quality_is_that_of_the_reference_package(name, sigma):
    """Within 0.3 dB: of the numbers recorded above, and of the package itself where it is installed."""
    truth = photograph(name)
    image = noisy(truth, sigma)
    ours = psnr(bm3d.denoise(image, float(sigma), peak=255.0), truth)
    assert abs(ours - RECORDED[name, sigma]) < 0.3


@pytest.mark.slow
def test_quality_is_that_of_the_reference_package_live():
    reference = pytest.importorskip("bm3d", reason="the non-commercial package bm3d is not installed (optional)")
    truth = photograph("camera")[100:228, 200:328]
    image = noisy(truth, 25)
    theirs = psnr(reference.bm3d(image, 25.0), truth)
    assert abs(psnr(bm3d.denoise(image, 25.0, peak=255.0), truth) - theirs) < 0.3


def test_wrong_images_and_noise_are_named():
    with pytest.raises(ValueError, match=r"expected finite numbers \[H, W\]"):
        bm3d.denoise(np.zeros((2, 8, 8)), 0.1)
    with pytest.raises(ValueError, match="sigma must be 0 or more and peak positive, got sigma -1"):
        bm3d.denoise(np.zeros((8, 8)), -1)
