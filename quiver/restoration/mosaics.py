"""Restores mosaics: each place of the colour filter array's tile alone, by any method; then the bands by demosaicing.

    codes [T, H, W] --places of the tile--> codes [T, h, w] --method--> light [T, H, W] --demosaicing--> [T, 3, H, W]

Pixels of one place see one colour, so their codes are a small stream of one band: a method needs to know no colours.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy import ndarray as Array

from qsim.files import Progress
from quiver.data.codes import Codes


def check_bands(codes: Codes) -> None:
    """Raise `ValueError` if the colours of a mask do not determine three bands."""
    if codes.colour is not None and not codes.bands_determined:
        raise ValueError(
            f"{codes.name}: the mask {' '.join(codes.colour.mask)} does not determine three bands; restore the bare "
            "array of its codes as one band"
        )


def places(codes: Codes) -> Iterator[tuple[tuple[int, int], Codes]]:
    """Yield row and column of each place of the tile, and the codes [T, h, w] of its pixels as a stream of one band.

    `ValueError` for frames smaller than the tile, and as of `check_bands`.
    """
    assert codes.colour is not None
    check_bands(codes)
    _, height, width = codes.shape
    rows, columns = codes.colour.tile
    if height < rows or width < columns:
        raise ValueError(
            f"{codes.name}: frames of {height} x {width} px are smaller than the mask's {rows} x {columns}"
        )
    for i, j in np.ndindex(rows, columns):
        yield (i, j), _place(codes, i, j)


def by_colour(codes: Codes) -> list[Codes]:
    """Return the codes of the first place of every colour, each with its own light; of one band the stream itself."""
    if codes.colour is None:
        return [codes]
    rows, columns = codes.colour.tile
    _, height, width = codes.shape
    found: dict[str, Codes] = {}
    for i, j in np.ndindex(min(rows, height), min(columns, width)):
        found.setdefault(codes.colour.mask[i][j], _place(codes, i, j))
    return list(found.values())


def _place(codes: Codes, i: int, j: int) -> Codes:
    """Return the codes [T, h, w] of the pixels at row i, column j of the tile, as a stream of one band."""
    assert codes.colour is not None
    length, height, width = codes.shape
    rows, columns = codes.colour.tile

    def read(start: int, stop: int) -> Array:
        return np.ascontiguousarray(codes.read(start, stop)[:, i::rows, j::columns])

    shape = (length, len(range(i, height, rows)), len(range(j, width, columns)))
    # The light behind a filter is the share of the three bands that it passes.
    seen = float(codes.colour.weights(codes.sensor.efficiency)[:, i, j].sum())
    ppp = None if codes.ppp is None else codes.ppp * seen
    name = f"{codes.name}, {codes.colour.mask[i][j]}"
    return replace(codes, name=name, shape=shape, read=read, ppp=ppp, colour=None, defective=None)


def fill_mosaic(
    fill: Callable[[Codes, Array, int, Progress | None], None],
    codes: Codes,
    out: Array,
    first: int,
    progress: Progress | None,
    joined: Callable[[Codes, Array], Array] = Codes.demosaiced,
) -> None:
    """Write the photons of R, G and B of frames `first` ... into out [t, 3, H, W]; `fill` restores one band.

    `joined` makes bands [3, H, W] of the light [H, W] of a frame.

    `out` is zero. Its first band collects the light of all places: `out` may be a file, and memory hold few frames.
    """
    assert codes.colour is not None
    rows, columns = codes.colour.tile
    light = out[:, 0]
    for n, ((i, j), place) in enumerate(places(codes)):
        fill(place, light[:, i::rows, j::columns], first, _share(progress, n, rows * columns, len(out)))
    for t in range(len(out)):
        out[t] = joined(codes, light[t].copy())


def _share(progress: Progress | None, n: int, places: int, frames: int) -> Progress | None:
    """Return the progress of place n as that of all, in frames."""
    if progress is None:
        return None
    return lambda done, total: progress((n * total + done) * frames // (places * total), frames)
