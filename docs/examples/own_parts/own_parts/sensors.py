"""Two sensors: one that states its law, and one that states only how it is drawn."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.special import gammaincc, gammaln, ndtri, xlogy

from qsim import DrawnSensor, Sensor


@dataclass(frozen=True)
class Trigger(Sensor):
    """One bit: 1 if at least `threshold` electrons came. P(code <= 0) = Q(threshold, arrivals)."""

    threshold: int = 5
    quantum_efficiency: float = 0.8
    bits: int = 1
    code_model: ClassVar[str] = "multibit"
    dark_rate: ClassVar[float] = 0.0

    @property
    def efficiency(self):
        return self.quantum_efficiency

    def white(self, exposure):
        return self.threshold / self.quantum_efficiency

    def cdf_of(self, arrivals, exposure):
        return np.stack([gammaincc(self.threshold, arrivals), np.ones_like(arrivals)], axis=-1)

    def log_pmf_of(self, arrivals, exposure, wanted=None):
        dark = gammaincc(self.threshold, arrivals)
        with np.errstate(divide="ignore"):
            return np.log(np.stack([dark, 1 - dark], axis=-1))

    def slope_of(self, arrivals, exposure):
        n = self.threshold
        slope = -np.exp(xlogy(n - 1, arrivals) - arrivals - gammaln(n))
        return np.stack([slope, np.zeros_like(arrivals)], axis=-1)


@dataclass(frozen=True)
class Noisy(DrawnSensor):
    """Light with normal noise of the size of shot noise, rounded: only a drawing function, no law."""

    noise: float = 1.0  # of the square root of the light
    bits: int = 4

    def white(self, exposure):
        return float(self.levels - 1)

    def draw_codes(self, photons, exposure, uniform):
        values = photons + self.noise * np.sqrt(photons) * ndtri(uniform(0))
        return np.clip(np.rint(values), 0, self.levels - 1)
