"""Which picture a tile takes, and the error that is stated: on synthetic pictures with a known truth."""

from __future__ import annotations

import numpy as np
import pytest
from stats import critical_z

from qsim.rendering.reuse.choice import BLOCK, TILE, best_of, products, reused_mean

SIZE = (120, 168)  # px
FRAMES = np.array([1, 3, 5, 7, 11])


def drawn(seed, bias):
    """Return truth [H, W] and pictures [5, 2, H, W] of 1/frames of the noise; from the second on with `bias` [H, W]."""
    rng = np.random.default_rng([17, seed])
    truth = 1 + 0.3 * rng.random(SIZE)
    each = 0.2 * rng.standard_normal((FRAMES[-1], 2, *SIZE))
    noise = np.cumsum(each, axis=0)[FRAMES - 1] / FRAMES[:, None, None, None]
    shift = bias * (FRAMES > 1)[:, None, None, None]
    return truth, truth + noise + shift


def test_tiles_take_many_frames_where_they_are_right_and_their_own_where_they_are_not():
    """Noise of 0.2 in each half; on the right a bias of twice that, in stripes of 2 px: a mean of tiles has none."""
    columns = np.arange(SIZE[1])
    bias = np.where(columns < 84, 0.0, 0.4 * (-1.0) ** (columns // 2)) * np.ones(SIZE)
    truth, pictures = drawn(0, bias)
    best, number = best_of(pictures, 10.0, False)
    assert (number[:, :8] == 4).mean() > 0.9
    assert (number[:, 13:] == 0).mean() > 0.9
    whole = [np.mean((p.mean(axis=0) - truth) ** 2) for p in (best, *pictures)]
    assert whole[0] < min(whole[1:])


@pytest.mark.parametrize("seed", range(8))
def test_products_are_those_of_numpy_s_sums_to_the_bit(seed):
    """Sums by rows and `np.add.reduceat` add the same numbers in the same order, at the last squares, too."""
    rng = np.random.default_rng([19, seed])
    apart = rng.standard_normal((2, *rng.integers(1, 60, 2)))
    rows, columns = (np.arange(0, size, BLOCK) for size in apart.shape[1:])

    def sums(values):
        return np.add.reduceat(np.add.reduceat(values, rows, axis=0), columns, axis=1)

    np.testing.assert_array_equal(products(apart), sums(apart[0]) * sums(apart[1]) / sums(np.ones(apart.shape[1:])))


@pytest.mark.parametrize("seed", range(4))
def test_a_tile_has_the_picture_of_its_number(seed):
    rng = np.random.default_rng([23, seed])
    pictures = rng.gamma(2.0, 1.0, (4, 2, *rng.integers(TILE, 60, 2)))
    best, number = best_of(pictures, 2.0, bool(seed % 2))
    spread = np.repeat(np.repeat(number, TILE, axis=0), TILE, axis=1)[: best.shape[1], : best.shape[2]]
    np.testing.assert_array_equal(best, np.take_along_axis(pictures, spread[None, None], axis=0)[0])


def test_a_tile_does_not_choose_for_itself():
    _, pictures = drawn(1, np.zeros(SIZE))
    _, before = best_of(pictures, 10.0, True)
    other = pictures.copy()
    other[1:, :, 5 * TILE : 6 * TILE, 7 * TILE : 8 * TILE] += 3.0
    _, after = best_of(other, 10.0, True)
    assert after[5, 7] == before[5, 7]
    around = after[3:8, 5:10].copy()
    around[2, 2] = 0
    assert np.all(around == 0)


def test_a_denoiser_tolerates_noise_but_no_bias():
    """A bias of half the noise of the frame: many frames are right if nothing follows, fewer before a denoiser."""
    _, pictures = drawn(2, np.full(SIZE, 0.07))
    raw, denoised = (best_of(pictures, 10.0, on)[1].mean() for on in (False, True))
    assert raw > 3.5
    assert denoised < 1.5


@pytest.mark.parametrize("size", [0.0, 0.05, 0.2])
@pytest.mark.parametrize("seed", range(3))
def test_the_stated_error_contains_the_bias(seed, size):
    """Noise and bias together, without the truth and without a bias from the choice of tiles.

    The sigma of the estimate is stated with it; one is added to what is returned.
    """
    columns = np.arange(SIZE[1])
    truth, pictures = drawn(seed, size * np.sin(columns / 9.0) * np.ones(SIZE))
    best, _ = best_of(pictures, 10.0, False)
    mixed = reused_mean(pictures[0], best, None, 10.0)
    real = float(np.mean((best.mean(axis=0) - truth) ** 2))
    sigma = float(mixed.squares.std()) / np.sqrt(mixed.squares.size)
    assert abs(float(mixed.squares.mean()) - real) < critical_z(checks=9) * sigma
    assert mixed.error**2 >= float(np.mean((best[0] - best[1]) ** 2) / 4)
    assert mixed.error_at(1.2) <= mixed.error


def test_a_bias_that_alternates_within_a_block_is_stated():
    columns = np.arange(SIZE[1])
    truth, pictures = drawn(4, 0.1 * (-1.0) ** columns * np.ones(SIZE))
    mixed = reused_mean(pictures[0], pictures[4], None, 10.0)
    real = float(np.mean((pictures[4].mean(axis=0) - truth) ** 2))
    sigma = float(mixed.squares.std()) / np.sqrt(mixed.squares.size)
    assert mixed.error_at(10.0, 0) ** 2 > real - critical_z(checks=1) * sigma
    blocks = float(products(mixed.apart).sum()) / truth.size
    assert blocks < real / 2, "blocks alone would see it, and this test would show nothing"


def test_the_stated_error_is_seldom_too_good():
    """By blocks it has less chance than by single pixels, and the larger of both is stated."""
    apart = []
    draws = 40
    for seed in range(draws):
        truth, pictures = drawn(seed, 0.05 * np.sin(np.arange(SIZE[1]) / 9.0) * np.ones(SIZE))
        mixed = reused_mean(pictures[0], pictures[3], None, 10.0)
        real = float(np.mean((pictures[3].mean(axis=0) - truth) ** 2))
        blocks = products(mixed.apart)
        sigma = float(blocks.std()) * np.sqrt(blocks.size) / truth.size
        apart.append((mixed.error_at(10.0, 0) ** 2 - real) / sigma)
    assert blocks.size * BLOCK**2 == truth.size
    assert min(apart) > -critical_z(checks=draws)


def test_a_part_of_a_picture_states_its_own_error():
    _, pictures = drawn(5, np.zeros(SIZE))
    pictures[:, :, :60] += 0.3 * np.sin(np.arange(SIZE[1]) / 3.0) * (np.arange(5) > 0)[:, None, None, None]
    mixed = reused_mean(pictures[0], pictures[4], None, 10.0)
    above, below = (mixed.cut((y, 0, 60, SIZE[1]), 1) for y in (0, 60))
    assert above.error > 2 * below.error
    assert above.apart.shape == (2, 60, SIZE[1])


def test_a_frame_smaller_than_a_tile_takes_its_own_samples():
    rng = np.random.default_rng(3)
    best, number = best_of(pictures := rng.random((3, 2, 5, 7)), 10.0, False)
    assert number.tolist() == [[0]]
    np.testing.assert_array_equal(best, pictures[0])
