"""Codes drawn into the memory of the device are those of the reference, at any size, crop and number of launches."""

import numpy as np
import pytest
from compiled_cases import EXPOSURE, KEY, OTHERS, SENSORS, light, needs_engine, reference

from qsim.keys import Key
from qsim.sensor.qis import QIS


def drawn(sensor, photons, origin=(0, 0), key=KEY):
    return sensor.sample_on_device(photons, EXPOSURE, key=key, origin=origin).numpy()


@needs_engine
def test_codes_equal_the_reference_for_random_sensors_sizes_and_crops():
    rng = np.random.default_rng(0)
    for name in rng.permutation(list(SENSORS))[:8]:
        shape = tuple(int(rng.integers(1, most)) for most in (4, 24, 70))
        origin = tuple(rng.integers(0, 9, 2).tolist())
        key = Key(int(rng.integers(100)), 5, int(rng.integers(50)))
        photons = light(SENSORS[name], shape, seed=int(rng.integers(100)))
        expected = np.stack(
            [
                SENSORS[name].sample(frame, EXPOSURE, key=key.at(key.frame + t), origin=origin, engine="reference")
                for t, frame in enumerate(photons)
            ]
        )
        np.testing.assert_array_equal(drawn(SENSORS[name], photons, origin, key), expected, strict=True)


@needs_engine
def test_uncertain_pixels_are_drawn_by_the_reference():
    """Some of a quarter of a million pixels are uncertain; all are equal."""
    sensor = SENSORS["3 bits, gain 1"]
    photons = light(sensor, (1, 512, 511), seed=1)
    np.testing.assert_array_equal(drawn(sensor, photons), reference(sensor, photons))


@needs_engine
@pytest.mark.parametrize("wrong", [-1.0, np.nan, np.inf])
def test_wrong_light_is_named_by_its_pixel(wrong):
    photons = np.ones((2, 5, 7), np.float32)
    photons[1, 2, 3] = wrong
    with pytest.raises(ValueError, match=r"photons\[1, 2, 3\] is .*; expected photons are finite and not negative"):
        drawn(SENSORS["3 bits, gain 1"], photons)


def test_photons_of_another_shape_or_type_are_refused():
    sensor = QIS(0.8, 1.6, 0.2, 3)
    for photons in (np.ones((5, 7), np.float32), np.ones((2, 5, 7)), np.ones((0, 5, 7), np.float32)):
        with pytest.raises(ValueError, match=r"photons have the shape \[T, H, W\] in float32"):
            drawn(sensor, photons)


@pytest.mark.parametrize("name", OTHERS)
def test_a_sensor_without_a_kernel_is_refused(name):
    with pytest.raises(ValueError, match="no compiled engine draws its codes on this machine; use `sample`"):
        drawn(OTHERS[name], np.ones((1, 5, 7), np.float32))
