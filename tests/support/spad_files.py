"""The files of a small SPAD camera, as docs/spad_camera.md names them: raw planes of one bit (spad_camera.py)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import spad_camera

SIZE = 64  # px
EFFICIENCY = 0.4  # detections per photon
DARK = 0.004  # detections per plane


def write_recordings(folder: Path, planes: int = 420) -> np.ndarray:
    """Write dark.bin, flat.bin, capture.bin and still.bin; return where hot pixels are, bool [H, W]."""
    shape = (SIZE, SIZE)
    hot, rate = spad_camera.hot_map(shape, 0.01, 7)
    camera = spad_camera.Camera(DARK + rate, EFFICIENCY)
    picture = spad_camera.texture(160, 3)
    even = spad_camera.still(np.ones(shape), shape)
    moved = spad_camera.panned(picture, shape, 0.05)  # px per plane
    scenes = {
        "dark": (spad_camera.still(np.zeros(shape), shape), 1.0, 2 * planes),
        "flat": (even, 0.8, 2 * planes),
        "capture": (moved, 0.7, planes),
        "still": (spad_camera.still(picture, shape), 0.7, planes),
    }
    for number, (name, (scene, light, count)) in enumerate(scenes.items()):
        codes = camera.codes(scene, light, count, 1, number)
        np.packbits(codes.reshape(count, -1), axis=1).tofile(folder / f"{name}.bin")
    return hot
