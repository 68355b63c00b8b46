"""Mean and variance of our codes beside those of the camera in emva1288, the standard's own simulator.

The simulator adds a uniform half code before it rounds, so that its codes vary by 1/12 more than those of one rounding.
"""

import numpy as np
import pytest
from stats import assert_mean, assert_variance

from qsim.sensor.qis import QIS

emva1288 = pytest.importorskip("emva1288.camera.camera")

WAVELENGTH = np.array([550.0])  # nm
# um, s, -, -, e-
PITCH = 5.0
EXPOSURE = 1e-3
F_NUMBER = 8
EFFICIENCY = 0.6
READ_NOISE = 2.0
OFFSET = 20.0  # e-; the simulator cuts electrons at 0
FRAMES = 16
SIDE = 256


@pytest.mark.parametrize("wanted_gain", [1.0, 0.5])
@pytest.mark.parametrize("photons", [10.0, 60.0, 400.0])
def test_mean_and_variance_are_those_of_the_standards_camera(photons, wanted_gain):
    from emva1288.camera import routines

    efficiency = routines.Qe(qe=np.full((SIDE, SIDE, 1), EFFICIENCY), wavelength=WAVELENGTH, width=SIDE, height=SIDE)
    camera = emva1288.Camera(
        f_number=F_NUMBER,
        pixel_area=PITCH**2,
        bit_depth=12,
        width=SIDE,
        height=SIDE,
        qe=efficiency,
        exposure=EXPOSURE * 1e9,
        K=wanted_gain,
        K_min=wanted_gain,
        K_max=wanted_gain,
        K_steps=1,
        blackoffset=0,
        dark_current_ref=0.0,
        dark_signal_0=OFFSET,
        sigma2_dark_0=READ_NOISE**2,
        u_esat=1e9,
        seed=1,
    )
    light = routines.get_radiance(camera.exposure, photons, camera.pixel_area, F_NUMBER, WAVELENGTH)
    codes = np.stack([camera.grab(light) for _ in range(FRAMES)]).astype(np.float64)

    gain = camera.K  # the simulator takes the nearest of its steps
    sensor = QIS(EFFICIENCY, dark_current=0.0, read_noise=READ_NOISE, bits=12, gain=gain, offset=gain * OFFSET)
    variance = float(sensor.variance(np.array(photons), EXPOSURE)) + 1 / 12
    assert_mean(codes, float(sensor.mean(np.array(photons), EXPOSURE)), variance, checks=12)
    assert_variance(codes, variance, 3 * variance**2 + gain**4 * EFFICIENCY * photons, checks=12)
