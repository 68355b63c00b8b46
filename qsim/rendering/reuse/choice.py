"""Chooses, tile by tile, from how many frames a picture is made, and states the error of what is returned.

    own halves + pictures from 1, 3, 5 ... frames -> one picture in two halves -> denoised or not -> picture, error

Let M be the mean of a frame's own halves A and B, and F any picture with halves F_A and F_B, where F_A has noise of the
first halves only. M has no bias. The bias and the noise of F, and its error, follow without the truth:

    bias^2 = E (F_A - A)(F_B - B),    noise^2 = E (F_A - F_B)^2 / 4,
    E (F - truth)^2 = E [(F - M)^2 + (F_A - F_B)(A - B) / 2 - (A - B)^2 / 4].

Shadows and reflections that do not follow their surface give a bias that is smoother than noise, so it is measured in
means of BLOCK x BLOCK pixels. A tile takes the picture, and then the share of its denoised version, that errs least in
the tiles around it, without the tile itself: the pixels that state its error have not chosen it. Their estimate has a
standard error of about 2 / sqrt(pixels) of the squared noise of M, however small the error of F is. The same estimate
from the means of blocks has half of it, but misses what alternates within a block. The larger of both is stated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy import ndarray as Array

from qsim.clip.clamped_error import Clamp
from qsim.lazy_array import Crop
from qsim.rendering.denoiser import Mixture, denoised, keeping_mean

TILE = 8  # px, side of a tile
BLOCK = 2  # px, side of the squares whose means show a bias; larger ones show less noise, but no edge of a shadow
NEIGHBOURHOOD = 5  # tiles, side of the square around a tile that chooses for it
LEFT_BY_DENOISER = 0.1  # of the squared noise, about; of bias it removes nothing


@dataclass(frozen=True, eq=False)
class SharedMixture(Mixture):
    """A mixture whose error is stated by its own samples: by single pixels and by blocks of them."""

    apart: Array = field(kw_only=True)  # [2, H, W], halves of the picture less the halves of the frame's own samples

    @property
    def error(self) -> float:
        """The rms error of the picture, W m^-2 sr^-1."""
        return self.error_at(math.inf)

    def error_at(self, white: float, sigmas: float = 1.0) -> float:
        """Return the rms error of picture and truth clamped at white, plus `sigmas` standard errors of the blocks'."""
        clamp = Clamp.at(white, self.picture, self.lower)
        single = float(clamp.squares(self.squares).mean())
        noise = float(clamp.squares(self.noise).mean())
        blocks = products(np.where(clamp.below, self.apart, 0))
        error = float(blocks.std()) * math.sqrt(blocks.size)
        stated = max(single, noise + float(blocks.sum()) / self.raw.size) + sigmas * error / self.raw.size
        least = float(np.mean(np.where(clamp.below, self.noise, 0)))
        return math.sqrt(max(stated, 0.01 * float(np.mean(np.minimum(self.raw, white**2))), least))

    def cut(self, crop: Crop, thinned: int) -> SharedMixture:
        """Return every n-th (`thinned`) row and column of a window (y, x, height, width)."""
        y, x, height, width = crop
        apart = self.apart[:, y : y + height : thinned, x : x + width : thinned]
        return replace(self, **vars(super().cut(crop, thinned)), apart=apart)


def best_of(pictures: Array, white: float, denoises: bool) -> tuple[Array, Array]:
    """Return the best picture of each tile, in two halves [2, H, W], and its number in each tile [h, w].

    `pictures` [n, 2, H, W] are the frame's own halves, then those from more and more frames. They are compared clamped
    at `white` [W m^-2 sr^-1, as all pictures]. Where a denoiser follows, noise counts by what it leaves of it.
    """
    clamped = np.minimum(pictures, white)
    own = clamped[0]
    scores = []
    for picture in clamped:
        noise = _around(_sums((picture[0] - picture[1]) ** 2 / 4, TILE))
        bias = _around(_sums(products(picture - own), TILE // BLOCK))
        scores.append(np.maximum(bias, 0) + (LEFT_BY_DENOISER if denoises else 1.0) * noise)
    number = np.argmin(scores, axis=0)
    chosen = _spread(number, own.shape[1:])
    best = pictures[0].copy()
    for i in range(1, len(pictures)):
        np.copyto(best, pictures[i], where=chosen == i)
    return best, number


def reused_mean(
    own: Array, best: Array, surfaces: tuple[Array, Array] | None, white: float, quality: str = "high"
) -> SharedMixture:
    """Return the picture of two halves `best` [2, H, W], denoised where that lowers its error against `own` [2, H, W].

    `surfaces` are albedo [H, W] and normals [H, W, 3] for the denoiser of this quality; None does not denoise. The mean
    is that of `best`, as `denoiser.cleaned_mean` keeps it.
    """
    if surfaces is None:
        return _mixed(own, best, best, np.zeros(own.shape[1:]))
    cleaned = np.stack([denoised(half, *surfaces, quality) for half in best])
    z = own[0] - own[1]
    apart = (cleaned - best).mean(axis=0)
    change = (cleaned[0] - cleaned[1]) - (best[0] - best[1])
    gain = -(apart * (best - own).mean(axis=0) + change * z / 4)
    # The share of the denoised picture with the least error of a tile, by that estimate: the minimum of a parabola.
    shares = _around(_sums(gain, TILE)) / np.maximum(_around(_sums(apart**2, TILE)), 1e-300)
    share = _spread(np.clip(shares, 0, 1), own.shape[1:])
    return keeping_mean(_mixed(own, best, cleaned, share), float(best.mean()), white)


def _mixed(own: Array, best: Array, cleaned: Array, share: Array) -> SharedMixture:
    mixed = share * cleaned + (1 - share) * best
    z = own[0] - own[1]
    middle = mixed.mean(axis=0)
    # Without bias, from two halves of independent noise: (M - O)^2 exceeds the error of M by
    # the variance of O, z^2 / 4, less twice their covariance, (M0 - M1) z / 4.
    squares = (middle - own.mean(axis=0)) ** 2 + (mixed[0] - mixed[1]) * z / 2 - z**2 / 4
    noise = (mixed[0] - mixed[1]) ** 2 / 4
    return SharedMixture(share, middle, mixed.min(axis=0), squares, z**2 / 4, noise, apart=mixed - own)


def products(apart: Array) -> Array:
    """Return the products of two differences' [2, H, W] sums in blocks, over the pixels of each block [h, w]."""
    first, second = (_sums(half, BLOCK) for half in apart)
    rows, columns = (np.minimum(BLOCK, size - np.arange(0, size, BLOCK)) for size in apart.shape[1:])
    return first * second / np.outer(rows, columns)


def _sums(values: Array, side: int) -> Array:
    """Return the sums of an array [H, W] in squares of this side; the last ones may be smaller."""
    return _sums_of_rows(_sums_of_rows(values, side).T, side).T


def _sums_of_rows(values: Array, side: int) -> Array:
    """Return the sums of each `side` rows of an array [H, W].

    A row of many pixels is added at once: four times as fast as `np.add.reduceat`, and the same to the bit.
    """
    rest = np.zeros((-(-len(values) // side), values.shape[1]))
    for k in range(1, side):
        rows = values[k::side]
        rest[: len(rows)] += rows
    return values[::side] + rest


def _around(tiles: Array) -> Array:
    """Return the sums over the tiles [h, w] around each, without itself."""
    from scipy.ndimage import uniform_filter

    count = NEIGHBOURHOOD**2
    return uniform_filter(tiles, NEIGHBOURHOOD, mode="constant") * count - tiles


def _spread(tiles: Array, shape: tuple[int, ...]) -> Array:
    """Return the value of each pixel's tile [H, W], from values of tiles [h, w]."""
    return np.repeat(np.repeat(tiles, TILE, axis=0), TILE, axis=1)[: shape[0], : shape[1]]
