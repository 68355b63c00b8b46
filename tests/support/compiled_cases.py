"""Sensors of every kind that the compiled engine serves, and both engines' codes of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from qsim.keys import Key
from qsim.sensor.compiled import jit
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.qis import QIS
from qsim.sensor.sensor import Sensor
from qsim.sensor.spad import BinarySPAD

KEY = Key(seed=3, clip=5, frame=7)
EXPOSURE = 5e-4  # s


def loaded_drjit() -> Any:
    """Return Dr.Jit with the LLVM that qsim chooses; whoever imports it first gets whichever the system has."""
    jit.backend()
    return pytest.importorskip("drjit", reason="Dr.Jit is not installed")


needs_engine = pytest.mark.skipif(not jit.available(), reason="no usable LLVM or CUDA on this machine")

SENSORS: dict[str, Sensor] = {
    "3 bits, gain 1": QIS(0.8, 1.6, 0.2, 3),
    "published gain": QIS(0.8, 3200.0, 0.2, 3, gain=0.5 * 7 / 3.25),
    "low gain": QIS(0.8, 1.6, 0.2, 3, gain=0.1346),
    "no read noise": QIS(0.8, 1.6, 0.0, 3),
    "one bit": QIS(0.8, 1.6, 0.2, 1),
    "five bits": QIS(0.8, 1.6, 0.2, 5),
    "full well": QIS(0.8, 1.6, 0.2, 3, full_well=4.0),
    "one plane": BinarySPAD(0.5, 10.0),
    "seven planes": BinarySPAD(0.5, 10.0, 3),
    "dead time": CountingSPAD(0.5, 100.0, 1e-4, 3),
    "four-bit counter": CountingSPAD(0.5, 100.0, 1e-6, 4),
}
SHORT = tuple(SENSORS)  # their steps are sums
SENSORS |= {  # steps that are looked up
    "noisy, with offset": QIS(0.8, 1.6, 5.1, 3, gain=0.3, offset=2.0),
    "long sums": QIS(0.8, 1.6, 0.3, 5, gain=0.3),
    "long sums without noise": QIS(0.8, 1.6, 0.0, 8, gain=0.02),
    "longer sums and full well": QIS(0.8, 1.6, 3.0, 7, gain=0.0085, offset=-20.0, full_well=9000.5),
    "much noise": QIS(0.8, 1.6, 9.0, 8),
    "eight-bit counter": CountingSPAD(0.5, 100.0, 3e-6, 8),
    "paralyzable": CountingSPAD(0.5, 100.0, 1e-4, 3, paralyzable=True),
    "paralyzable, six bits": CountingSPAD(0.5, 100.0, 4e-6, 6, paralyzable=True),
}
# Where no kernel serves
OTHERS: dict[str, Sensor] = {
    "ten bits": QIS(0.8, 1.6, 5.1, 10, offset=32.0),
    "nine-bit counter": CountingSPAD(0.5, 100.0, 1e-7, 9),
}


def light(sensor: Sensor, shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    """Photons from dark to twice white, float32."""
    top = 2 * sensor.white(EXPOSURE)
    return np.random.default_rng(seed).uniform(0, top, shape).astype(np.float32)


def fast(sensor: Sensor, photons: np.ndarray, origin: tuple[int, int] = (0, 0), key: Key = KEY) -> np.ndarray:
    """Codes of the compiled engine, for any number of pixels under the fixture `compile_everything`."""
    return sensor.sample(photons, EXPOSURE, key=key, origin=origin, engine="fast")


def fast_packed(sensor: Sensor, photons: np.ndarray, origin: tuple[int, int] = (0, 0), key: Key = KEY) -> np.ndarray:
    return sensor.sample_packed(photons, EXPOSURE, key=key, origin=origin, engine="fast")


def reference(sensor: Sensor, photons: np.ndarray, origin: tuple[int, int] = (0, 0)) -> np.ndarray:
    return sensor.sample(photons, EXPOSURE, key=KEY, origin=origin, engine="reference")
