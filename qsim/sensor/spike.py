"""Models spike cameras: pixels that collect charge, fire at a threshold, and are read as one bit at every clock tick.

    charge += N,  N ~ Poisson(QE photons + dark t);   spike = charge >= threshold;   charge -= threshold, or charge = 0

A pixel fires at most once per plane. Reset by subtraction keeps the charge above the threshold without limit: after n
planes of k thresholds each, a pixel glows on in the dark for (k - 1) n planes. Reset to zero loses it. The charge
begins anywhere below the threshold with equal probability, as in a camera that has been running. Spikes have a memory:
the planes of a pixel are drawn in order, from the first.

**The law of one plane** at constant light, in the long run, with n electrons per plane and a threshold of m:

    subtraction   P(spike) = min(n / m, 1), since no charge is lost
    to zero       P(spike) = 1 / E[I],  P(I > i) = P(Poisson(i n) < m): intervals I between spikes are independent
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy import ndarray as Array

from qsim.arrays import plain
from qsim.keys import Key, require_counters, uniform, uniform_pair, words
from qsim.sensor.distribution import MOST_EVENTS, check_exposure, require_number, require_size
from qsim.sensor.poisson import poisson_log_pmf, poisson_quantile
from qsim.sensor.sensor import Sensor

MOST = 1 << 20  # electrons of a threshold
_TERMS = 256  # planes of an interval that are summed one by one; longer ones by a Fourier series
_WAVES = 128  # of that series; its terms fall at least with the fourth power
_CHUNK = 1 << 12  # levels of light at a time


@dataclass(frozen=True)
class SpikeCamera(Sensor):
    """An integrate-and-fire pixel, read once per plane."""

    quantum_efficiency: float  # electrons per photon, 0 ... 1
    dark_current: float  # e-/s
    threshold: int  # e-, 1 ... 2^20
    subtracts: bool = True  # reset by subtraction: bright pixels glow on; false: to zero
    bits: int = 1

    code_model: ClassVar[str] = "spikes"
    keeps_charge: ClassVar[bool] = True

    def __post_init__(self) -> None:
        require_number(self, "quantum_efficiency", 0, 1, open_low=True)
        require_number(self, "dark_current", 0)
        require_size(self, "quantum_efficiency", 1e-12, 1.0)
        require_size(self, "dark_current", 1e-30, MOST_EVENTS)
        if type(self.threshold) is not int or not 1 <= self.threshold <= MOST:
            raise ValueError(
                f"SpikeCamera.threshold is a whole number of electrons, 1 ... {MOST}; got {self.threshold!r}"
            )
        if not isinstance(self.subtracts, bool):
            raise ValueError(f"SpikeCamera.subtracts is true or false, got {self.subtracts!r}")
        if self.bits != 1:
            raise ValueError(f"SpikeCamera.bits is 1, a spike or none per plane; got {self.bits!r}")

    @property
    def efficiency(self) -> float:
        return self.quantum_efficiency

    @property
    def dark_rate(self) -> float:
        return self.dark_current

    def law(self, *, summed: bool = False, disturbed: bool = False, read_out: bool = False) -> str:
        return "spikes"

    def with_dark_rate(self, rate: float) -> SpikeCamera:
        return replace(self, dark_current=rate)

    def white(self, exposure: float) -> float:
        """Return threshold / QE, the photons per plane [exposure in s] that fire in every plane."""
        return self.threshold / self.quantum_efficiency

    # ---- The law of one plane at constant light, in the long run

    def cdf_of(self, arrivals: Array, exposure: float) -> Array:
        _, quiet = self._shares(arrivals)
        return np.stack([quiet, np.ones_like(quiet)], axis=-1)

    def log_pmf_of(self, arrivals: Array, exposure: float, wanted: Array | None = None) -> Array:
        with np.errstate(divide="ignore"):
            return np.stack([np.log(share) for share in reversed(self._shares(arrivals))], axis=-1)

    def slope_of(self, arrivals: Array, exposure: float) -> Array:
        if self.subtracts:
            slope = np.where(arrivals < self.threshold, 1 / self.threshold, 0.0)
        else:
            longer, change = self._interval(arrivals)
            # P(spike) = 1 / E[I], and d(1 / E) = -dE / E^2.
            slope = -change / (1 + longer) ** 2
        return np.stack([-slope, np.zeros_like(slope)], axis=-1)

    def _shares(self, arrivals: Array) -> tuple[Array, Array]:
        """Return the shares of planes with and without a spike, [p] each, both without cancellation."""
        if self.subtracts:
            fired = np.minimum(arrivals / self.threshold, 1.0)
            return fired, 1 - fired
        longer, _ = self._interval(arrivals)
        with np.errstate(invalid="ignore"):
            return 1 / (1 + longer), np.where(np.isinf(longer), 1.0, longer / (1 + longer))

    def _interval(self, arrivals: Array) -> tuple[Array, Array]:
        """Return E[I] - 1 of a pixel that is reset to zero, and its derivative over the arrivals, [p] each."""
        parts = [
            interval(np.asarray(arrivals[start : start + _CHUNK], float), self.threshold)
            for start in range(0, max(len(arrivals), 1), _CHUNK)
        ]
        longer, change = (np.concatenate(each) for each in zip(*parts, strict=True))
        return longer, change

    # ---- Drawing

    def sample(
        self, photons: Array, exposure: float, *, key: Key, origin: tuple[int, int] = (0, 0), engine: str = "auto"
    ) -> Array:
        """Return spikes of expected photons [H, W], or [T, H, W] = planes key.frame + t of one pixel after the other.

        The first plane begins with a random charge. There is one engine, exact in float64. `exposure` in seconds.
        """
        photons = plain(photons)
        stack = photons if photons.ndim == 3 else photons[None]
        if stack.ndim != 3:
            raise ValueError(f"photons have the shape [H, W] or [T, H, W], got {list(photons.shape)}")
        require_counters(key, stack.shape, origin)
        spikes = np.concatenate(list(self.spikes([stack], exposure, key, origin)))
        return spikes if photons.ndim == 3 else spikes[0]

    def blocks(
        self,
        photons: Iterable[Array],
        exposure: float,
        key: Key,
        origin: tuple[int, int] = (0, 0),
        engine: str = "auto",
    ) -> Iterator[Array]:
        return self.spikes(photons, exposure, key, origin)

    def spikes(
        self, blocks: Iterable[Array], exposure: float, key: Key, origin: tuple[int, int] = (0, 0)
    ) -> Iterator[Array]:
        """Yield spikes uint8 [t, H, W] of blocks of photons [t, H, W], which follow each other from key.frame on."""
        check_exposure(exposure)
        charge: Array | None = None
        frame = key.frame
        for block in blocks:
            found = np.empty(block.shape, np.uint8)
            for t, photons in enumerate(block):
                at = key.at(frame + t)
                charge = self.start(at, photons.shape, origin) if charge is None else charge
                found[t], charge = self.advance(charge, photons, exposure, at, origin)
            frame += len(block)
            yield found

    def start(self, key: Key, shape: tuple[int, ...], origin: tuple[int, int] = (0, 0)) -> Array:
        """Return the charge before the first plane, whole electrons [H, W], uniform below the threshold (to 2^-32)."""
        return np.floor(uniform(words(key, shape, origin, 2)) * self.threshold)

    def advance(
        self, charge: Array, photons: Array, exposure: float, key: Key, origin: tuple[int, int] = (0, 0)
    ) -> tuple[Array, Array]:
        """Return the spikes [H, W] of one plane and the charge [H, W] after it, from the charge before and its light.

        Error: that of the inverted Poisson cdf, below 1e-13 in any probability.
        """
        first, second = (words(key, photons.shape, origin, redraw) for redraw in (0, 1))
        charge = charge + poisson_quantile(self.arrivals(photons, exposure), *uniform_pair(first, second))
        # One spike a plane at most: further thresholds stay in the charge, or are lost by a reset to zero.
        fired = charge >= self.threshold
        return fired, np.where(fired, charge - self.threshold if self.subtracts else 0.0, charge)


def interval(arrivals: Array, threshold: int) -> tuple[Array, Array]:
    """Return E[I] - 1 = sum over i >= 1 of P(Poisson(i n) < m), and its derivative over n: [p] of electrons n [p].

    Long intervals take Poisson's sum formula: m / n - 1/2 + sum over k of Im(phi_k) / (pi k), where phi_k = (1 - 2 pi i
    k / n)^-m is the transform of the waiting time for m electrons. Infinite in the dark.
    """
    from scipy.special import pdtr

    longer = np.full(arrivals.shape, np.inf)
    change = np.full(arrivals.shape, -np.inf)
    reach = threshold + 12 * np.sqrt(threshold) + 60  # electrons after which a pixel has fired, to 1e-16
    bright = arrivals * _TERMS >= reach
    # Bright: intervals are short, and P(I > i) is summed until the pixel has fired for certain.
    planes = np.arange(1, _TERMS + 1)
    light = arrivals[bright, None]
    longer[bright] = pdtr(threshold - 1, planes * light).sum(axis=1)
    change[bright] = -(planes * np.exp(poisson_log_pmf(planes * light, np.array(threshold - 1)))).sum(axis=1)
    dim = ~bright & (arrivals > 0)
    light = arrivals[dim, None]
    if threshold == 1:  # the transform falls too slowly, and the sum is geometric
        longer[dim] = 1 / np.expm1(light[:, 0])
        change[dim] = -np.exp(light[:, 0]) / np.expm1(light[:, 0]) ** 2
        return longer, change
    k = np.arange(1, _WAVES + 1)
    base = 1 - 2j * np.pi * k / np.maximum(light, 1e-6)  # below, the waves are negligible
    phi = np.exp(-threshold * np.log(base))
    longer[dim] = threshold / light[:, 0] - 0.5 + (phi.imag / (np.pi * k)).sum(axis=1)
    slope = -threshold * phi / base * (2j * np.pi * k / np.maximum(light, 1e-6) ** 2)
    change[dim] = -threshold / light[:, 0] ** 2 + (slope.imag / (np.pi * k)).sum(axis=1)
    return longer, change
