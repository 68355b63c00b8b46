"""Random codes of a 3-bit QIS."""

from __future__ import annotations

import numpy as np

from qsim.sensor.qis import QIS
from quiver.data.codes import Codes, array_codes

EXPOSURE = 5e-4  # s
SENSOR = QIS(0.8, 1.6, 0.2, 3, gain=3.5 / 3.25)


def random_codes(frames: int, height: int, width: int, seed: int = 0) -> Codes:
    """Codes uint8 [T, H, W], each value as likely as the others."""
    drawn = np.random.default_rng(seed).integers(0, 8, (frames, height, width), dtype=np.uint8)
    return array_codes(drawn, SENSOR, EXPOSURE)
