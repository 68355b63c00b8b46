"""One sensor of every kind of law, for tests of the code that all sensors share."""

from __future__ import annotations

import pytest

from qsim.sensor.counting import CountingSPAD
from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD

EXPOSURE = 5e-4
SENSORS = (
    QIS(0.8, 1.6, 0.2, 3, gain=1.0769),
    QIS(0.8, 3200.0, 0.2, 3, gain=0.359, full_well=20.0),
    QIS(1.0, 0.0, 0.0, 1),
    BinarySPAD(0.4, 100.0),
    BinarySPAD(0.4, 100.0, 3),
    CountingSPAD(0.5, 200.0, 3e-8, 3),
    CountingSPAD(0.5, 200.0, 1e-4, 4),
    CountingSPAD(0.5, 200.0, 5e-5, 4, paralyzable=True),
)
each = pytest.mark.parametrize("sensor", SENSORS, ids=lambda s: f"{type(s).__name__}-{s.bits}")
