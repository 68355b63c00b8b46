"""Numbers of any size: right answers or one sentence, and always an end."""

from __future__ import annotations

import contextlib
from dataclasses import fields
from itertools import product
from typing import Any

import numpy as np
import pytest

from qsim.keys import Key
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.qis import QIS
from qsim.sensor.sensor import Sensor
from qsim.sensor.spad import BinarySPAD
from qsim.sensor.spike import SpikeCamera

SIZES = (1e-308, 1e-300, 1e-100, 1e-12, 1e12, 1e100, 1e300, 1.7e308, -1e300)
RECORDS: tuple[Sensor, ...] = (
    QIS(0.8, 1.0, 0.2, 3, full_well=50.0),
    QIS(0.8, 1.0, 0.2, 12, offset=20.0),
    BinarySPAD(0.4, 10.0, 3),
    BinarySPAD(0.4, 10.0, 12),
    CountingSPAD(0.4, 10.0, 1e-7, 4),
    CountingSPAD(0.4, 10.0, 1e-7, 12),
    CountingSPAD(0.4, 10.0, 1e-5, 4, paralyzable=True),
    SpikeCamera(0.4, 10.0, 400),
)
WHOLE = ("bits", "threshold", "paralyzable", "subtracts")


def _respond(sensor: Sensor, exposure: float, light: float) -> None:
    table = sensor.response(exposure)
    for values in (table.photons, table.mean, table.variance):
        assert np.isfinite(values).all()


def _sample(sensor: Sensor, exposure: float, light: float) -> None:
    codes = sensor.sample(np.array([[0.0, 1.0, light]]), exposure, key=Key(1, 2), engine="reference")
    assert codes.max() <= sensor.levels - 1


def _plan(sensor: Sensor, exposure: float, light: float) -> None:
    sensor.kernel_plan(exposure)


CASES = [
    (record, name, size, call)
    for record in RECORDS
    for name in (*(field.name for field in fields(record) if field.name not in WHOLE), "exposure", "light")  # type: ignore[arg-type]
    for size, call in product(SIZES, (_respond, _sample, _plan))
]


@pytest.mark.parametrize("part", [0, *(pytest.param(p, marks=pytest.mark.slow) for p in range(1, 8))])
def test_numbers_of_any_size_give_answers_or_one_sentence(part):
    """No traceback, warning, infinity, or draw without end (12 bits at 1e18 photons)."""
    chosen = np.random.default_rng(3).permutation(len(CASES))[part::8]
    for record, name, size, call in (CASES[i] for i in chosen):
        given: dict[str, Any] = vars(record) | ({} if name in ("exposure", "light") else {name: size})
        exposure, light = (size if name == wanted else usual for wanted, usual in (("exposure", 5e-4), ("light", 30.0)))
        with contextlib.suppress(ValueError):  # of one sentence, which the tests of each number read
            call(type(record)(**given), exposure, light)


@pytest.mark.parametrize("sensor", RECORDS[:6])
def test_more_light_than_any_pixel_holds_saturates(sensor: Sensor):
    codes = sensor.sample(np.full((1, 5), 1e18), 5e-4, key=Key(1, 2), engine="reference")
    highest = np.flatnonzero(sensor.log_pmf(1e12, 5e-4) > -1)
    np.testing.assert_array_equal(codes, np.full((1, 5), highest[-1]))
