"""Restores the photons of R, G and B from the light behind a colour filter array of any mask and efficiencies.

    mosaic [..., H, W]  --one linear filter per place of the tile-->  photons of R, G, B [..., 3, H, W]

The filters are the best linear estimates for a Gaussian picture whose bands have the correlation BETWEEN and whose
values at a distance of d pixels the correlation exp(-d / LENGTH). Flat colours come back exactly: the mean of each band
has no prior. Colours that mix (W, crosstalk of filters) are separated by the same equations. Constants were chosen
among few on photographs (docs/log.md).
"""

from __future__ import annotations

import functools

import numpy as np
from numpy import ndarray as Array

from qsim.sensor.colour_filter import ColourFilter

BETWEEN = 0.9  # correlation of two bands at one place
LENGTH = 12.0  # px, over which a picture keeps exp(-1) of its correlation
NOISE = 1e-2  # variance of the mosaic's error over that of the picture
MOST_REACH = 5  # px
_FLAT = 1e4  # variance of each band's mean over that of the picture


def demosaic(mosaic: Array, filters: ColourFilter, efficiency: float, *, floor: bool = True) -> Array:
    """Return photons of R, G and B, float64 [..., 3, H, W], of the light [..., H, W] that `filters.mosaic` makes.

    `efficiency` is that of the sensor. With `floor` values are cut off at 0, as for a picture; without it noise in dim
    bands adds no light. `ValueError` for frames smaller than the tile, and for masks whose colours do not determine
    three bands.
    """
    height, width = mosaic.shape[-2:]
    rows, columns = filters.tile
    if height < rows or width < columns:
        raise ValueError(f"demosaicing: frames of {height} x {width} px are smaller than the tile, {rows} x {columns}")
    kernels = kernels_of(filters, efficiency)
    reach = kernels.shape[-1] // 2
    y = within(height, rows, reach)
    x = within(width, columns, reach)
    padded = np.asarray(mosaic, np.float64)[..., y[:, None], x]
    out = np.empty((*mosaic.shape[:-2], 3, height, width))
    for i, j in np.ndindex(rows, columns):
        windows = np.lib.stride_tricks.sliding_window_view(padded, (2 * reach + 1,) * 2, axis=(-2, -1))
        place = windows[..., i:height:rows, j:width:columns, :, :]
        found = np.tensordot(place, kernels[i, j], axes=((-2, -1), (-2, -1)))
        out[..., i::rows, j::columns] = np.moveaxis(found, -1, -3)
    return np.maximum(out, 0) if floor else out


def determines_bands(filters: ColourFilter, efficiency: float) -> bool:
    """Return whether the colours of a mask determine three bands; one filter over all pixels does not."""
    return bool(np.linalg.matrix_rank(filters.weights(efficiency).reshape(3, -1), tol=1e-6) == 3)


def kernels_of(filters: ColourFilter, efficiency: float) -> Array:
    """Return the linear filters of a mask, float64 [rows, columns, 3, n, n]: one for each place of the tile and band.

    `ValueError` for masks whose colours do not determine three bands.
    """
    if not determines_bands(filters, efficiency):
        raise ValueError(f"demosaicing: the mask {' '.join(filters.mask)} does not determine three bands")
    return _kernels(filters.weights(efficiency).tobytes(), *filters.tile)


def within(count: int, period: int, before: int, after: int | None = None) -> Array:
    """Return indices [before + count + after] of a line with places before and, by default as many, after.

    Those outside are the nearest of their phase.
    """
    at = np.arange(-before, count + (before if after is None else after))
    at = np.where(at < 0, at % period, at)
    last = count - 1 - (count - 1 - at) % period
    return np.where(at >= count, last, at)


@functools.lru_cache(maxsize=32)
def _kernels(weights: bytes, rows: int, columns: int) -> Array:
    """Return the filters [rows, columns, 3, n, n] of a tile; `weights` are its bytes, float64 [3, rows, columns]."""
    tile = np.frombuffer(weights).reshape(3, rows, columns)
    reach = min(MOST_REACH, max(3, rows, columns))
    dy, dx = (each.ravel() for each in np.mgrid[-reach : reach + 1, -reach : reach + 1])
    near = np.exp(-np.hypot(dy[:, None] - dy, dx[:, None] - dx) / LENGTH)
    here = np.exp(-np.hypot(dy, dx) / LENGTH)
    # The prior: bands and places are correlated independently of each other, so that covariances are products.
    between = np.full((3, 3), BETWEEN) + (1 - BETWEEN) * np.eye(3)
    found = np.empty((rows, columns, 3, 2 * reach + 1, 2 * reach + 1))
    for i, j in np.ndindex(rows, columns):
        own = tile[:, (i + dy) % rows, (j + dx) % columns]  # [3, pixels]
        # Wiener's filter: covariance of the seen pixels, with the prior of flat
        # colours and noise, and covariance of them with the wanted bands.
        both = own.T @ between @ own * near + _FLAT * (own.T @ own) + NOISE * np.eye(len(dy))
        seen = between @ own * here + _FLAT * own
        found[i, j] = np.linalg.solve(both, seen.T).T.reshape(found.shape[2:])
    found.setflags(write=False)
    return found
