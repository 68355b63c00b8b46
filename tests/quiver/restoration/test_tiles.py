"""Tiles cover the frame within a bound on their pixels; weights of overlapping ones sum to one."""

from __future__ import annotations

import numpy as np
import pytest

from quiver.restoration.pieces import cores, cut_tiles, extents, spans


@pytest.mark.parametrize("blend", [False, True])
def test_tiles_cover_the_frame_within_the_bound(blend):
    """Random frames, bounds, reaches and strides: weights sum to 1, tiles fit and start at multiples of the stride."""
    rng = np.random.default_rng(0)
    cut = 0
    for _ in range(60):
        height, width = (int(n) for n in rng.integers(1, 400, 2))
        multiple = int(rng.choice([1, 4, 8, 16]))
        reach = int(rng.choice([0, 5, 32, 36]))
        pixels = int(rng.integers(1000, 60_000))
        if pixels < min(height, multiple + 80) * min(width, multiple + 80):
            continue  # not even the smallest tile fits
        tiles = cut_tiles(height, width, pixels, reach, multiple, blend=blend)
        total = np.zeros((height, width))
        for tile in tiles:
            rows, columns = tile.weight.shape
            assert rows * columns <= pixels
            assert tile.y % multiple == tile.x % multiple == 0
            total[tile.y : tile.y + rows, tile.x : tile.x + columns] += tile.weight
        cut += len(tiles) > 1
        np.testing.assert_allclose(total, 1, atol=1e-6)
    assert cut > 20


def test_the_cut_with_the_smallest_area_is_taken():
    """Against all cuts tried one by one; 0.33 megapixel under 500 MB was 2 x 3 tiles of 343 px, 2.1 times the frame."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        height, width = (int(n) for n in rng.integers(60, 200, 2))
        pixels = int(rng.integers(3000, height * width))

        def area(tall: int, wide: int, height: int = height, width: int = width) -> tuple[int, int]:
            rows, columns = ([b - a for a, b in extents(n, c, 16)] for n, c in ((height, tall), (width, wide)))
            return max(rows) * max(columns), sum(rows) * sum(columns)

        tried = [area(tall, wide) for tall in range(8, height + 8, 8) for wide in range(8, width + 8, 8)]
        fitting = [whole for most, whole in tried if most <= pixels]
        assert area(*cores(height, width, pixels, 16, 8))[1] == min(fitting)
    tiles = cut_tiles(576, 576, 500_000_000 // 4248, 32, 16, blend=True)
    assert sum(tile.weight.size for tile in tiles) < 1.3 * 576 * 576


def test_a_bound_below_one_tile_is_refused():
    with pytest.raises(ValueError, match=r"tile needs at least 80 x 80; raise memory="):
        cut_tiles(200, 200, 1000, 32, 16)


@pytest.mark.parametrize("length", [1, 79, 80, 81, 100, 333])
def test_weights_of_overlapping_spans_sum_to_one(length):
    for blend in (False, True):
        total = np.zeros(length)
        for start, weight in spans(length, 24, 32, blend):
            total[start : start + len(weight)] += weight
        np.testing.assert_allclose(total, 1, atol=1e-6)
