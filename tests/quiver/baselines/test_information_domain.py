"""The scale phi: against integrals, closed forms and moments, for random sensors."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import gammaincc, gammaln, xlogy

from qsim import Sensor
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD
from quiver.baselines.information_domain import information_domain

EXPOSURE = 5e-4


def random_sensor(rng):
    bits = int(rng.integers(1, 8))
    match rng.integers(3):
        case 0:
            return QIS(rng.uniform(0.2, 1), float(rng.choice([0, 1.6, 3200])), rng.uniform(0.15, 0.5), bits)
        case 1:
            return BinarySPAD(rng.uniform(0.05, 1), float(rng.choice([0, 25])), bits)
        case _:
            return CountingSPAD(rng.uniform(0.05, 1), 25.0, float(rng.choice([0, 1e-6, 2e-5])), min(bits, 5))


@pytest.mark.parametrize("seed", range(12))
def test_phi_is_the_integral_of_the_root_of_the_information(seed):
    rng = np.random.default_rng(seed)
    sensor = random_sensor(rng)
    domain = information_domain(sensor, EXPOSURE)
    low, high = np.sort(rng.uniform(0.02, 0.5, 2)) * domain.photons[-1]

    def integrand(root):
        return 2 * root * np.sqrt(float(sensor.fisher_information(np.array(root**2), EXPOSURE)))

    expected = quad(integrand, np.sqrt(low), np.sqrt(high), limit=200, epsrel=1e-8)[0]
    found = np.diff(np.interp([low, high], domain.photons, domain.phi))[0]
    assert found == pytest.approx(expected, rel=1e-4, abs=1e-4)  # 4096 points, linear between them


@pytest.mark.parametrize("efficiency", [0.1, 0.5, 1.0])
def test_phi_of_a_binary_pixel_is_an_arcsine(efficiency):
    domain = information_domain(BinarySPAD(efficiency, 0.0, 1), EXPOSURE)
    chance = -np.expm1(-efficiency * domain.photons)
    assert domain.phi == pytest.approx(2 * np.arcsin(np.sqrt(chance)), abs=2e-4)


def test_phi_of_a_photon_counter_is_twice_a_square_root():
    domain = information_domain(QIS(1.0, 0.0, 0.0, 7), EXPOSURE)
    dim = domain.photons < 60  # far from saturation
    assert domain.phi[dim] == pytest.approx(2 * np.sqrt(domain.photons[dim]), rel=2e-3, abs=2e-3)


@pytest.mark.parametrize("seed", range(12))
def test_the_noise_of_phi_has_the_stated_deviation(seed):
    """The mean of 400 codes, drawn 4000 times: the delta method errs by a few percent, the draw by 1.1 % rms."""
    rng = np.random.default_rng(100 + seed)
    sensor = random_sensor(rng)
    codes = 400
    draws = 4000
    domain = information_domain(sensor, EXPOSURE)
    chosen = rng.uniform(0.1, 0.9) * domain.mean_code[-1]
    photons = float(np.interp(chosen, domain.mean_code, domain.photons))
    pmf = sensor.pmf(np.array(photons), EXPOSURE)
    counts = rng.multinomial(codes, pmf / pmf.sum(), size=draws)
    mean_code = counts @ np.arange(sensor.levels) / codes
    expected = domain.noise(np.array(chosen)) / np.sqrt(codes)
    assert domain.forward(mean_code).std() == pytest.approx(float(expected), rel=0.03 + 5 / np.sqrt(2 * draws))
    assert float(expected) >= 0.97 / np.sqrt(codes)  # no estimate has less noise than the information allows


@pytest.mark.parametrize(
    "sensor",
    [
        QIS(0.8, 3200.0, 0.2, 3),
        QIS(0.8, 3200.0, 0.2, 5, gain=4.0),
        QIS(0.8, 1.6, 2.0, 4),
        QIS(0.8, 1.6, 1.0, 5, offset=3.0),
        BinarySPAD(0.4, 2000.0, 4),
        CountingSPAD(0.5, 1000.0, 1e-5, 3),
    ],
)
def test_noise_of_a_dark_pixel_is_no_light(sensor):
    """Cut off at darkness, the mean of phi would be 0.4 deviations instead of none."""
    domain = information_domain(sensor, EXPOSURE)
    codes = 400
    draws = 4000
    pmf = sensor.pmf(np.array(0.0), EXPOSURE)
    counts = np.random.default_rng(0).multinomial(codes, pmf / pmf.sum(), size=draws)
    phi = domain.forward(counts @ np.arange(sensor.levels) / codes)
    deviation = float(domain.noise(domain.mean_code[0])) / np.sqrt(codes)
    assert abs(phi.mean()) < (0.05 + 5 / np.sqrt(draws)) * deviation  # phi is bent: up to 0.05 deviations
    assert phi.std() == pytest.approx(deviation, rel=0.03 + 5 / np.sqrt(2 * draws))


@pytest.mark.parametrize("gain", [0.5 / 26, 0.5 / 100, 0.5 / 400])
def test_a_dark_pixel_below_a_high_threshold_is_finite(gain):
    """The mean code of a dark pixel, and its rise, are down to 1e-300."""
    domain = information_domain(QIS(0.8, 1.6, 0.2, 1, gain=gain), EXPOSURE)
    assert domain.forward(np.array([0.0, 1e-30])) == pytest.approx([0.0, 0.0], abs=1e-4)


@pytest.mark.parametrize("seed", range(6))
def test_photons_come_back_where_codes_tell_something(seed):
    domain = information_domain(random_sensor(np.random.default_rng(200 + seed)), EXPOSURE)
    inner = (domain.mean_code > 0.02 * domain.mean_code[-1]) & (domain.mean_code < 0.98 * domain.mean_code[-1])
    photons = domain.photons[inner]
    phi = domain.phi[inner]
    assert domain.inverse(phi) == pytest.approx(photons, rel=1e-5)
    assert domain.forward(domain.mean_code[inner]) == pytest.approx(phi, rel=1e-5)


def test_where_codes_tell_nothing_light_is_unknown():
    """A bit with a threshold at 52 electrons says nothing about 10 photons, and much about 65."""
    domain = information_domain(QIS(0.8, 1.6, 0.2, 1, gain=0.5 / 52), EXPOSURE)
    dark, useful = np.interp([10.0, 65.0], domain.photons, domain.slope)
    assert dark > 1e6 * useful


def test_a_sensor_without_response_is_refused():
    with pytest.raises(ValueError, match="does not rise with light"):
        information_domain(QIS(1.0, 0.0, 0.2, 1, offset=300.0), EXPOSURE)


def test_tables_are_made_once():
    assert information_domain(BinarySPAD(0.5, 0.0, 2), EXPOSURE) is information_domain(
        BinarySPAD(0.5, 0.0, 2), EXPOSURE
    )


@dataclass(frozen=True)
class Staircase(Sensor):
    """A law of one's own: how many of the thresholds 2, 5 and 9 electrons were reached, as differences of its cdf."""

    bits: int = 2
    code_model: ClassVar[str] = "multibit"
    dark_rate: ClassVar[float] = 3.0
    efficiency: ClassVar[float] = 0.5

    def white(self, exposure):
        return 18.0

    def cdf_of(self, arrivals, exposure):
        return np.stack([*(gammaincc(n, arrivals) for n in (2, 5, 9)), np.ones_like(arrivals)], axis=-1)

    def log_pmf_of(self, arrivals, exposure, wanted=None):
        with np.errstate(divide="ignore"):
            return np.log(np.diff(self.cdf_of(arrivals, exposure), axis=-1, prepend=0.0))

    def slope_of(self, arrivals, exposure):
        slopes = [-np.exp(xlogy(n - 1, arrivals) - arrivals - gammaln(n)) for n in (2, 5, 9)]
        return np.stack([*slopes, np.zeros_like(arrivals)], axis=-1)


def test_a_law_that_loses_small_probabilities_is_named():
    with pytest.raises(ValueError, match=r"Staircase: at .* photons log_pmf_of states a probability of 0"):
        information_domain(Staircase(), EXPOSURE)
