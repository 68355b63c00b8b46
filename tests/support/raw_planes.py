"""Files of photon counting cameras for tests: the inverses of the readers in qsim/formats/raw_cameras.py."""

from __future__ import annotations

import numpy as np
from numpy import ndarray as Array


def half(planes: Array) -> bytes:
    """Planes [T, 256, 512] as SwissSPAD2 half-array bytes."""
    return np.packbits(planes.reshape(-1), bitorder="little").tobytes()


def full(planes: Array) -> bytes:
    """Planes [T, 512, 512] as SwissSPAD2 full-array bytes."""
    zones = np.empty((len(planes), 256, 4, 2, 128), np.uint8)
    zones[:, :, :, 0] = planes[:, :256].reshape(-1, 256, 4, 128)
    zones[:, :, :, 1] = planes[:, :255:-1].reshape(-1, 256, 4, 128)
    return np.packbits(zones.reshape(-1), bitorder="little").tobytes()


def spad512s(planes: Array) -> bytes:
    """Planes [T, 512, 512] as SPAD512S bytes, without footer."""
    return np.packbits(planes.reshape(-1)).tobytes()


def spike(planes: Array) -> bytes:
    """Planes [T, H, W] with H*W a multiple of 8 as spike-camera bytes."""
    return np.packbits(planes[:, ::-1].reshape(-1), bitorder="little").tobytes()
