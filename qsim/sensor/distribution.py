"""States the exact law of a memoryless pixel: one cdf, and all that follows from it without drawing.

A pixel that expects `photons` during `exposure` is completely described by

    F_k = P(code <= k | photons, exposure),    k = 0 ... 2^b - 1.

A model (qis.py, spad.py, counting.py) states F, log P(code = k) and dF/dphotons as functions of the Poisson mean
arrivals = efficiency photons + dark_rate exposure. Mean, variance, likelihood, Fisher information and the codes of
uniform numbers are written here, once.

**Codes.** Every pixel has one uniform number u (keys.py) and code = #{k : u >= F_k}. More light moves F down, so codes
grow with light at a fixed u. Sensors that differ only in their number of bits give the same code as far as both can
write it. Where 32 bits of u cannot decide, 32 more are drawn; tails are resolved to 2^-64 on both sides.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from math import inf, isfinite
from operator import index
from typing import Any, ClassVar

import numpy as np
from numpy import ndarray as Array

from qsim.arrays import plain
from qsim.host import own_numbers
from qsim.keys import uniform, uniform_pair

_TOGETHER = 1 << 22  # probabilities held at a time
MOST_EVENTS = 1e15  # expected per exposure; every sensor within the limits of its numbers is saturated by less
# s, of an exposure
LONGEST = 1e9
SHORTEST = 1e-18
MANY_BITS = 9  # from which moments are computed from the codes near the mean


@own_numbers
class Distribution(ABC):
    """The law of the codes of one pixel. Subclasses are frozen dataclasses of its parameters."""

    def __init_subclass__(cls) -> None:
        """Let the methods of a subclass compute as in a program that has set nothing in NumPy, too."""
        own_numbers(cls)

    bits: int  # of a code, 1 ... 16
    code_model: ClassVar[str]  # kind of code: "multibit" read, "binary_sum" of planes, "counting"
    law_follows_exposure: ClassVar[bool] = True  # F_k depends on the exposure, too, and not on arrivals alone

    @property
    @abstractmethod
    def efficiency(self) -> float:
        """Return the Poisson events (electrons, avalanches) per photon."""

    @property
    @abstractmethod
    def dark_rate(self) -> float:
        """Return the Poisson events without light [1/s]."""

    @abstractmethod
    def white(self, exposure: float) -> float:
        """Return the photons per exposure [s] at which restored video has the value 1."""

    @abstractmethod
    def cdf_of(self, arrivals: Array, exposure: float) -> Array:
        """Return F: Poisson means [p] -> float64 [p, levels]."""

    @abstractmethod
    def log_pmf_of(self, arrivals: Array, exposure: float, wanted: Array | None = None) -> Array:
        """Return log P(code = k): Poisson means [p] -> float64 [p, levels].

        Entries outside `wanted` (bool [p, levels]) may be -inf where the probability is below 1e-290.
        """

    @abstractmethod
    def slope_of(self, arrivals: Array, exposure: float) -> Array:
        """Return dF/darrivals: Poisson means [p] -> float64 [p, levels]."""

    @property
    def levels(self) -> int:
        """Return the number of codes, 2^bits."""
        return 1 << self.bits

    @property
    def dtype(self) -> type[np.unsignedinteger[Any]]:
        """Return the type of codes: uint8 up to 8 bits, uint16 above."""
        return np.uint8 if self.bits <= 8 else np.uint16

    def arrivals(self, photons: Array, exposure: float) -> Array:
        """Return the expected Poisson events per exposure [s]: photons [...] -> float64 [...], at most MOST_EVENTS.

        `ValueError` names the first value of `photons` that is negative or not finite.
        """
        check_exposure(exposure)
        values = plain(photons, np.float64)
        wrong = ~(np.isfinite(values) & (values >= 0))
        if wrong.any():
            where = tuple(int(i) for i in np.argwhere(wrong)[0])
            raise ValueError(
                f"photons{list(where) if where else ''} is {float(values[where])!r}; "
                "expected photons are finite and not negative"
            )
        with np.errstate(over="ignore"):
            return np.minimum(self.efficiency * values + self.dark_rate * exposure, MOST_EVENTS)

    def cdf(self, photons: Array, exposure: float) -> Array:
        """Return P(code <= k): photons [...] -> float64 [..., levels]."""
        return self._over_levels(self.cdf_of, photons, exposure)

    def log_pmf(self, photons: Array, exposure: float, wanted: Array | None = None) -> Array:
        """Return log P(code = k): photons [...] -> float64 [..., levels]; exact in tails, where differences of F are 0.

        Sums of probabilities below 1e-290 are made in logarithms, which is slow. `wanted` (bool, same shape) limits
        them: other entries may be -inf.
        """
        arrivals = self.arrivals(photons, exposure)
        some = None if wanted is None else np.asarray(wanted).reshape(-1, self.levels)
        return self.log_pmf_of(arrivals.ravel(), exposure, some).reshape(*arrivals.shape, self.levels)

    def pmf(self, photons: Array, exposure: float) -> Array:
        """Return P(code = k): photons [...] -> float64 [..., levels]; values below 1e-290 may be 0."""
        nothing = np.zeros((*np.shape(photons), self.levels), bool)
        return np.exp(self.log_pmf(photons, exposure, nothing))

    def dcdf(self, photons: Array, exposure: float) -> Array:
        """Return dF_k/dphotons: photons [...] -> float64 [..., levels]."""
        return self.efficiency * self._over_levels(self.slope_of, photons, exposure)

    def _over_levels(self, function: Any, photons: Array, exposure: float) -> Array:
        arrivals = self.arrivals(photons, exposure)
        return np.asarray(function(arrivals.ravel(), exposure)).reshape(*arrivals.shape, self.levels)

    def mean(self, photons: Array, exposure: float) -> Array:
        """Return the expected code: photons [...] -> float64 [...]."""
        return self.moments(photons, exposure)[0]

    def variance(self, photons: Array, exposure: float) -> Array:
        """Return the variance of the code: photons [...] -> float64 [...]."""
        return self.moments(photons, exposure)[1]

    def moments(self, photons: Array, exposure: float) -> tuple[Array, Array]:
        """Return mean and variance of the code: photons [...] -> float64 [...] each."""
        arrivals = self.arrivals(photons, exposure)
        mean, variance = self.moments_of(arrivals.ravel(), exposure)
        return mean.reshape(arrivals.shape), variance.reshape(arrivals.shape)

    @property
    def many_codes(self) -> bool:
        """Return whether tables over all codes would take long, and series or sums near the mean replace them."""
        return self.bits >= MANY_BITS

    def moments_of(self, arrivals: Array, exposure: float) -> tuple[Array, Array]:
        """Return mean and variance of the code: Poisson means [p] -> [p] each.

        A model overrides this where codes are many; `dense_moments_of` is the reference.
        """
        return self.dense_moments_of(arrivals, exposure)

    def code_laws(self, codes: Array, arrivals: float, exposure: float) -> tuple[Array, Array]:
        """Return log P(code) of some codes int [c] at one Poisson mean, and its derivative by that mean: [c] each."""
        light = np.array([arrivals])
        logs = self.log_pmf_of(light, exposure)[0, codes]
        change = np.diff(self.slope_of(light, exposure)[0], prepend=0.0)[codes]
        with np.errstate(over="ignore", invalid="ignore"):
            return logs, np.where(change == 0, 0.0, change * np.exp(-logs))

    def dense_moments_of(self, arrivals: Array, exposure: float) -> tuple[Array, Array]:
        """Return mean and variance [...] of the code at arrivals [...], from the probabilities of all codes."""
        codes = np.arange(self.levels, dtype=float)
        mean = np.empty(len(arrivals))
        variance = np.empty(len(arrivals))
        step = max(1, _TOGETHER // self.levels)
        for start in range(0, len(arrivals), step):
            some = slice(start, start + step)
            nothing = np.zeros((len(arrivals[some]), self.levels), bool)
            pmf = np.exp(self.log_pmf_of(arrivals[some], exposure, nothing))
            mean[some] = pmf @ codes
            variance[some] = np.sum(pmf * (codes - mean[some, None]) ** 2, axis=-1)
        return mean, variance

    def log_likelihood(self, codes: Array, photons: Array, exposure: float) -> Array:
        """Return log P(code | photons) of each code, in the broadcast shape of the two."""
        codes = plain(codes)
        if codes.size and not (codes.dtype.kind in "ui" and codes.min() >= 0 and codes.max() < self.levels):
            raise ValueError(f"codes are integers 0 ... {self.levels - 1} of this {self.bits}-bit sensor")
        table = self.log_pmf(photons, exposure)
        shape = np.broadcast_shapes(codes.shape, table.shape[:-1])
        table = np.broadcast_to(table, (*shape, self.levels))
        chosen = np.broadcast_to(codes, shape)[..., None].astype(np.intp)
        return np.take_along_axis(table, chosen, axis=-1)[..., 0]

    def fisher_information(self, photons: Array, exposure: float) -> Array:
        """Return the information of one code about photons [1/photons^2]: photons [...] -> float64 [...].

        It is infinite at 0 photons where light makes a code possible.
        """
        slope = np.diff(self.dcdf(photons, exposure), axis=-1, prepend=0.0)
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            terms = np.exp(2 * np.log(np.abs(slope)) - self.log_pmf(photons, exposure, slope != 0))
        return np.where(slope == 0, 0.0, terms).sum(axis=-1)

    def brightest(self, exposure: float) -> float:
        """Return the photons up to which the mean code grows with light."""
        return inf

    def draw(self, photons: Array, exposure: float, first: Array, second: Callable[[Array], Array]) -> Array:
        """Return codes [...] of one word per pixel: words uint32 [...], and expected photons that broadcast to them.

        `second` returns further words [n] of the n pixels of a mask, bool [...], that the first words do not decide.
        """
        codes, undecided = self.decide(uniform(first), photons, exposure)
        if undecided.any():
            light = np.broadcast_to(photons, first.shape)[undecided]
            codes[undecided] = self.codes_at(first[undecided], second(undecided), light, exposure)
        return codes

    def decide(self, u: Array, photons: Array, exposure: float) -> tuple[Array, Array]:
        """Return codes int [...] and where 32 bits do not decide, bool [...], of uniform numbers [...] and photons.

        The photons broadcast to the shape of the numbers.
        """
        cdf = self.cdf(photons, exposure)[..., :-1]
        u = u[..., None]
        return np.count_nonzero(u >= cdf, axis=-1), (np.abs(u - cdf) <= 2.0**-32).any(axis=-1)

    def codes_at(self, first: Array, second: Array, photons: Array, exposure: float) -> Array:
        """Return codes [p] of two words uint32 [p] each: a 64-bit number, compared from the nearer end."""
        below, above = (u[:, None] for u in uniform_pair(first, second))
        pmf = self.pmf(photons, exposure)
        cdf = np.cumsum(pmf, axis=1)[:, :-1]
        survival = np.cumsum(pmf[:, :0:-1], axis=1)[:, ::-1]
        return np.count_nonzero(np.where(below < 0.5, below >= cdf, above <= survival), axis=1)


def check_exposure(exposure: float) -> None:
    if not (isfinite(exposure) and exposure > 0):
        raise ValueError(f"exposure is in seconds, finite and above 0, got {exposure!r}")
    if not SHORTEST <= exposure <= LONGEST:
        raise ValueError(f"exposure is {exposure:g} s; {SHORTEST:g} to {LONGEST:g} s can be computed with")


def require_number(record: Any, name: str, low: float, high: float = np.inf, *, open_low: bool = False) -> None:
    """Raise ValueError unless the field is a finite number in low ... high (or above low)."""
    value = getattr(record, name)
    number = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    if not (number and isfinite(value) and (value > low if open_low else value >= low) and value <= high):
        least = f"above {low:g}" if open_low else f"at least {low:g}"
        limits = least if high == np.inf else f"{least} and at most {high:g}"
        if low == -np.inf:
            limits = "finite"
        raise ValueError(f"{type(record).__name__}.{name} is a number, {limits}; got {value!r}")
    object.__setattr__(record, name, float(value))


def require_size(record: Any, name: str, least: float, most: float) -> None:
    """Raise ValueError for a number that is neither 0 nor of a size that sums and powers of it can be computed with."""
    value = getattr(record, name)
    if value is not None and value != 0 and not least <= abs(value) <= most:
        raise ValueError(
            f"{type(record).__name__}.{name} is {value:g}; 0 and sizes from {least:g} to {most:g} can be computed with"
        )


def require_bits(record: Any) -> None:
    """Raise ValueError unless the field `bits` is an integer 1 ... 16."""
    try:
        bits = index(record.bits)
    except TypeError:
        bits = 0
    if not 1 <= bits <= 16:
        raise ValueError(f"{type(record).__name__}.bits is an integer 1 ... 16, got {record.bits!r}")
    object.__setattr__(record, "bits", bits)
