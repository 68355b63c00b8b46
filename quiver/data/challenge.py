"""Gives the colours of cubes of the Single Photon Challenge as codes, summed so that the last code ends with the cube.

    cube uint8 [T, H, ceil(W/8), 3]  ->  for each colour codes [T // planes, H, W]

The truth belongs to the last plane, so planes that fill no code are left out at the start.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy import ndarray as Array

from qsim.arrays import plain
from qsim.checks import ArgumentError
from qsim.formats.challenge import COLOURS, DETECTIONS, Cube, cubes, picture
from qsim.plane_sums import PlaneSums
from quiver.data.codes import Codes, summed
from quiver.data.illumination import ideal_clocked

__all__ = ["COLOURS", "Cube", "band_codes", "cubes", "light_of_band", "picture"]

RATE = 2000.0  # planes per second: the benchmark states none, and nothing depends on it without dark counts


def band_codes(cube: Cube, colour: int, planes: int) -> Codes:
    """Return one colour (0, 1, 2) of a cube as codes that sum `planes` planes each, of an ideal clocked SPAD.

    `ArgumentError` for more planes than the cube has.
    """
    frames, height, width = cube.shape
    if frames < planes:
        raise ArgumentError("planes", f"{cube.path}: has {frames}, fewer than the {planes} of one code; give fewer")
    packed = cube.packed.channel(colour)

    def read(start: int, stop: int) -> Array:
        return np.unpackbits(plain(packed[start:stop]), axis=2, count=width)

    single = Codes(
        name=f"{cube.name} {COLOURS[colour]}",
        shape=(frames, height, width),
        sensor=ideal_clocked(),
        exposure=1 / RATE,
        frame_rate=RATE,
        read=read,
        source=f"{cube.path}, {COLOURS[colour]}",
    )
    return summed(single, PlaneSums(start=frames % planes, planes=planes))


def light_of_band(photons: Sequence[Array], planes: int) -> Array:
    """Return linear light [H, W, 3], 1 at white, of the restored photons [H, W] per code of the three colours."""
    return np.stack(photons, axis=-1) / (planes * DETECTIONS)
