"""States which sensor saw a window, in place of a network's inputs: those are then made of a complete batch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from quiver.data.codes import Codes, Sensor

SENSORS = "sensors"  # of the windows of a batch, a list
TOP = "top code"  # of each of them


@dataclass(frozen=True)
class SeenBy:
    """What saw a window: all that inputs need to know beside its codes."""

    sensor: Sensor
    exposure: float  # s
    white: float  # photons
    sample: int  # number of the window


def seen_by(codes: Codes, sample: int) -> dict[str, Any]:
    """Return the sensor of a window, in place of inputs: those are made of the complete batch."""
    return stated(codes.sensor, codes.exposure, sample)


def stated(sensor: Sensor, exposure: float, sample: int) -> dict[str, Any]:
    """Return what `seen_by` does of codes of this sensor and exposure [s]."""
    top = torch.tensor(sensor.levels - 1, dtype=torch.float32)
    return {SENSORS: SeenBy(sensor, exposure, sensor.white(exposure), sample), TOP: top}
