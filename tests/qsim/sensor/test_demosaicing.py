"""Tests demosaicing: flat colours exactly, pictures better than interpolation, mixed colours apart, mistakes."""

from pathlib import Path

import numpy as np
import pytest
import skimage
from PIL import Image

from qsim.colour import psnr, to_linear
from qsim.sensor.colour_filter import MASKS, ColourFilter
from qsim.sensor.demosaicing import demosaic

CROSSED = {"R": (0.5, 0.06, 0.01), "G": (0.05, 0.6, 0.09), "B": (0.01, 0.08, 0.4), "W": (0.7, 0.75, 0.6)}


def photograph(name: str) -> np.ndarray:
    """A photograph as linear photons of R, G and B, [3, 131, 127], white 20."""
    path = Path(skimage.__file__).parent / "data" / name
    pixels = np.asarray(Image.open(path).convert("RGB"))[60:191, 100:227]
    return 20 * np.moveaxis(to_linear(pixels, "srgb", 255.0), -1, 0).astype(float)


def interpolated(mosaic: np.ndarray, filters: ColourFilter) -> np.ndarray:
    """Every band from its own pixels alone, by normalised bilinear weights."""
    from scipy.ndimage import convolve

    kernel = np.outer([1, 2, 1], [1, 2, 1]) / 4.0
    own = (filters.over(1.0, *mosaic.shape) > 0).astype(float)
    return np.stack([convolve(mosaic * m, kernel) / np.maximum(convolve(m, kernel), 1e-9) for m in own])


def decibels(one: np.ndarray, other: np.ndarray) -> float:
    return psnr(20.0, float(np.sqrt(np.mean((one - other)[:, 4:-4, 4:-4] ** 2))))


def test_flat_colours_come_back_from_every_mask():
    """Over random masks with three bands or more, efficiencies, sizes that the tile does not divide, and colours."""
    rng = np.random.default_rng(0)
    done = 0
    while done < 25:
        rows, columns = (int(n) for n in rng.integers(1, 5, 2))
        mask = tuple("".join("RGBW"[i] for i in row) for row in rng.integers(0, 4, (rows, columns)))
        filters = ColourFilter(mask, {c: CROSSED[c] for c in set("".join(mask))})
        if np.linalg.matrix_rank(filters.weights(0.8).reshape(3, -1)) < 3:
            continue
        done += 1
        height = rows + int(rng.integers(0, 9))
        width = columns + int(rng.integers(0, 9))
        flat = np.broadcast_to(rng.uniform(0.5, 20, (3, 1, 1)), (3, height, width))
        np.testing.assert_allclose(demosaic(filters.mosaic(flat, 0.8), filters, 0.8), flat, rtol=2e-3)


@pytest.mark.parametrize("name", ["astronaut.png", "coffee.png", "chelsea.png"])
def test_photographs_are_restored_better_than_by_interpolation(name):
    picture = photograph(name)
    filters = ColourFilter(MASKS["rggb"])
    mosaic = filters.mosaic(picture, 0.8)
    assert decibels(demosaic(mosaic, filters, 0.8), picture) > decibels(interpolated(mosaic, filters), picture) + 1


@pytest.mark.parametrize("name", ["rggb", "quad", "rgbw"])
@pytest.mark.parametrize("crossed", [False, True])
def test_mixed_colours_are_separated(name, crossed):
    """Filters that pass three bands cost little: their mixture is part of the equations."""
    picture = photograph("chelsea.png")
    colours = set("".join(MASKS[name]))
    filters = ColourFilter(MASKS[name], {c: CROSSED[c] for c in colours} if crossed else None)
    assert decibels(demosaic(filters.mosaic(picture, 0.8), filters, 0.8), picture) > 30


def test_frames_of_a_stack_are_restored_alone():
    filters = ColourFilter(MASKS["quad"])
    stack = np.random.default_rng(1).uniform(0, 9, (2, 3, 9, 11))
    both = demosaic(filters.mosaic(stack, 1.0), filters, 1.0)
    for t in range(2):
        np.testing.assert_allclose(both[t], demosaic(filters.mosaic(stack[t], 1.0), filters, 1.0), rtol=1e-12)


def test_what_cannot_be_restored_is_named():
    with pytest.raises(ValueError, match=r"frames of 3 x 9 px are smaller than the tile, 4 x 4"):
        demosaic(np.ones((3, 9)), ColourFilter(MASKS["quad"]), 1.0)
    with pytest.raises(ValueError, match="the mask RG GR does not determine three bands"):
        demosaic(np.ones((8, 9)), ColourFilter(("RG", "GR")), 1.0)
