"""What every sensor is: one exact cdf, and all that follows from it.

A memoryless pixel that expects `photons` during `exposure` is completely described by

    F_k = P(code <= k | photons, exposure),    k = 0 ... 2^b - 1.

A model (qis.py, spad.py) says F, log P(code = k) and dF/dphotons as functions of the Poisson mean
arrivals = efficiency photons + dark_rate exposure; mean, variance, likelihood, Fisher information, estimates,
variance stabilisation and the draw itself are written here, once.

**The draw.** Every pixel has one uniform number u (keys.py) and code = #{k : u >= F_k}. More light moves F down: codes
grow with light at a fixed key, and sensors that differ only in their number of bits draw the same code as far as both
can write it. Where 32 bits of u cannot decide, 32 more are drawn; tails are resolved to 2^-64 on both sides.
"""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from dataclasses import asdict
from functools import cache
from math import inf, isfinite
from operator import index
from typing import Any, ClassVar

import numpy as np
from numpy import ndarray as Array

from qsim.keys import Key, uniform, uniform_pair, words
from qsim.sensor import estimation
from qsim.sensor.estimation import Estimate, Response
from qsim.sensor.packing import pack

_CHUNK = 1 << 18  # probabilities in one block of a draw (2 MiB)
ENGINES = ("auto", "reference", "fast")
_UNITS = {
    "quantum_efficiency": "e-/photon",
    "dark_current": "e-/s",
    "read_noise": "e- rms",
    "gain": "codes/e-",
    "offset": "codes",
    "full_well": "e-",
    "pde": "avalanches/photon",
    "dark_count_rate": "1/s",
    "dead_time": "s",
}


class Sensor(ABC):
    """A pixel without memory. Subclasses are frozen dataclasses of their parameters."""

    bits: int  # of a code, 1 ... 16
    code_model: ClassVar[str]  # what a code is: "multibit" read, "binary_sum" of planes, "counting"

    @property
    @abstractmethod
    def efficiency(self) -> float:
        """Poisson events (electrons, avalanches) per photon."""

    @property
    @abstractmethod
    def dark_rate(self) -> float:
        """Poisson events without light [1/s]."""

    @abstractmethod
    def white(self, exposure: float) -> float:
        """Photons at which restored video has the value 1."""

    @abstractmethod
    def _cdf(self, arrivals: Array, exposure: float) -> Array:
        """F: Poisson means [p] -> [p, levels]."""

    @abstractmethod
    def _log_pmf(self, arrivals: Array, exposure: float, wanted: Array | None = None) -> Array:
        """log P(code = k): Poisson means [p] -> [p, levels]; entries not `wanted` may come out as -inf below 1e-290."""

    @abstractmethod
    def _slope(self, arrivals: Array, exposure: float) -> Array:
        """dF/darrivals: Poisson means [p] -> [p, levels]."""

    def __str__(self) -> str:
        """Parameters with their units; `repr` is the code that makes this sensor."""
        given = {name: value for name, value in vars(self).items() if value is not None}
        shown = {name: f"{value:.6g}" if isinstance(value, float) else str(value) for name, value in given.items()}
        values = [f"{name} {text} {_UNITS.get(name, '')}".rstrip() for name, text in shown.items()]
        return f"{type(self).__name__} ({self.code_model}): " + ", ".join(values)

    def _repr_pretty_(self, printer: Any, cycle: bool) -> None:
        """What a notebook shows."""
        printer.text(str(self))

    @property
    def levels(self) -> int:
        """Number of codes, 2^bits."""
        return 1 << self.bits

    @property
    def dtype(self) -> type[np.unsignedinteger[Any]]:
        """Of codes: uint8 up to 8 bits, uint16 above."""
        return np.uint8 if self.bits <= 8 else np.uint16

    def arrivals(self, photons: Array, exposure: float) -> Array:
        """Expected Poisson events per pixel and exposure; ValueError for photons that are no light level."""
        _check_exposure(exposure)
        values = np.asarray(photons, np.float64)
        wrong = ~(np.isfinite(values) & (values >= 0))
        if wrong.any():
            where = tuple(int(i) for i in np.argwhere(wrong)[0])
            raise ValueError(
                f"photons{list(where) if where else ''} is {float(values[where])!r}; "
                "expected photons are finite and not negative"
            )
        return self.efficiency * values + self.dark_rate * exposure

    def cdf(self, photons: Array, exposure: float) -> Array:
        """P(code <= k): photons [...] -> float64 [..., levels]."""
        return self._over_levels(self._cdf, photons, exposure)

    def log_pmf(self, photons: Array, exposure: float, wanted: Array | None = None) -> Array:
        """log P(code = k): photons [...] -> float64 [..., levels]; exact in the tails, where differences of F are 0.

        Below 1e-290 sums in logarithms take their time; entries that `wanted` (bool, same shape) excuses may be -inf.
        """
        arrivals = self.arrivals(photons, exposure)
        some = None if wanted is None else np.asarray(wanted).reshape(-1, self.levels)
        return self._log_pmf(arrivals.ravel(), exposure, some).reshape(*arrivals.shape, self.levels)

    def pmf(self, photons: Array, exposure: float) -> Array:
        """P(code = k): photons [...] -> float64 [..., levels]; what is below 1e-290 may be 0."""
        nothing = np.zeros((*np.shape(photons), self.levels), bool)
        return np.exp(self.log_pmf(photons, exposure, nothing))

    def dcdf(self, photons: Array, exposure: float) -> Array:
        """dF_k/dphotons: photons [...] -> float64 [..., levels]."""
        return self.efficiency * self._over_levels(self._slope, photons, exposure)

    def _over_levels(self, function: Any, photons: Array, exposure: float) -> Array:
        arrivals = self.arrivals(photons, exposure)
        return np.asarray(function(arrivals.ravel(), exposure)).reshape(*arrivals.shape, self.levels)

    def mean(self, photons: Array, exposure: float) -> Array:
        """Expected code, [...]."""
        return self.pmf(photons, exposure) @ np.arange(self.levels, dtype=float)

    def variance(self, photons: Array, exposure: float) -> Array:
        """Variance of the code, [...]."""
        pmf, codes = self.pmf(photons, exposure), np.arange(self.levels, dtype=float)
        return np.sum(pmf * (codes - (pmf @ codes)[..., None]) ** 2, axis=-1)

    def log_likelihood(self, codes: Array, photons: Array, exposure: float) -> Array:
        """log P(code | photons) of each code, in the broadcast shape of the two."""
        codes = np.asarray(codes)
        if codes.size and not (codes.dtype.kind in "ui" and codes.min() >= 0 and codes.max() < self.levels):
            raise ValueError(f"codes are integers 0 ... {self.levels - 1} of this {self.bits}-bit sensor")
        table = self.log_pmf(photons, exposure)
        shape = np.broadcast_shapes(codes.shape, table.shape[:-1])
        table = np.broadcast_to(table, (*shape, self.levels))
        chosen = np.broadcast_to(codes, shape)[..., None].astype(np.intp)
        return np.take_along_axis(table, chosen, axis=-1)[..., 0]

    def fisher_information(self, photons: Array, exposure: float) -> Array:
        """Of one code about photons [1/photons^2]; infinite at 0 photons where light makes a code possible."""
        slope = np.diff(self.dcdf(photons, exposure), axis=-1, prepend=0.0)
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            terms = np.exp(2 * np.log(np.abs(slope)) - self.log_pmf(photons, exposure, slope != 0))
        return np.where(slope == 0, 0.0, terms).sum(axis=-1)

    def maximum_likelihood(self, histogram: Array, exposure: float, confidence: float = 0.95) -> Estimate:
        """Light from codes of the same light: counts of each code [..., levels] -> Estimate of arrays [...] in photons.

        `lower` and `upper` bound the likelihood-ratio interval of this confidence; at all-dark and all-saturated
        histograms the estimate is finite and the bound one-sided (see Estimate). ValueError for an empty histogram.
        Where the mean code falls again with light (paralyzable pixels) the answer is the darker of the two.
        """
        return estimation.maximum_likelihood(self, histogram, exposure, confidence)

    def response(self, exposure: float) -> Response:
        """Tables of mean, variance and variance-stabilised code over light, and their inverses."""
        return estimation.response(self, exposure)

    def brightest(self, exposure: float) -> float:
        """Photons up to which the mean code grows with light."""
        return inf

    def sample(
        self, photons: Array, exposure: float, *, key: Key, origin: tuple[int, int] = (0, 0), engine: str = "auto"
    ) -> Array:
        """Codes of [H, W], or of [T, H, W] = frames key.frame + t; `origin` (y, x) places a crop in the full frame.

        `engine`: "reference" is NumPy in float64; "fast" is compiled (kernels.py) and differs from it in at most 5
        pixels per million; "auto" takes the fast one where it can run.
        """
        photons = _checked(photons, engine)
        _check_exposure(exposure)
        if engine != "reference" and _fast_engine():
            from qsim.sensor.compiled import launch

            return launch.sample(self, photons, exposure, key=key, origin=origin)
        if photons.ndim == 2:
            return self._draw(photons, exposure, key, origin)
        codes = np.empty(photons.shape, self.dtype)
        for t, frame in enumerate(photons):
            codes[t] = self._draw(frame, exposure, key.at(key.frame + t), origin)
        return codes

    def sample_packed(
        self, photons: Array, exposure: float, *, key: Key, origin: tuple[int, int] = (0, 0), engine: str = "auto"
    ) -> Array:
        """The codes of `sample`, packed row by row: uint8 [..., H, ceil(W bits / 8)] as `codes.pack` makes them.

        The compiled engine joins the bits itself, without a byte per code in between.
        """
        photons = _checked(photons, engine)
        _check_exposure(exposure)
        if engine != "reference" and _fast_engine():
            from qsim.sensor.compiled import launch

            return launch.sample_packed(self, photons, exposure, key=key, origin=origin)
        return pack(self.sample(photons, exposure, key=key, origin=origin, engine="reference"), self.bits)

    def _draw(self, photons: Array, exposure: float, key: Key, origin: tuple[int, int]) -> Array:
        """The reference draw of one frame [H, W], some rows at a time."""
        return self._draw_rows(photons, exposure, key, origin, _CHUNK // self.levels)

    def _draw_rows(self, photons: Array, exposure: float, key: Key, origin: tuple[int, int], pixels: int) -> Array:
        codes = np.empty(photons.shape, self.dtype)
        rows = max(1, pixels // max(photons.shape[1], 1))
        for y in range(0, photons.shape[0], rows):
            block = np.asarray(photons[y : y + rows], np.float64)
            place = (origin[0] + y, origin[1])
            first = words(key, block.shape, place)
            drawn, tail = self.decide(uniform(first), block, exposure)
            if tail.any():
                second = words(key, block.shape, place, redraw=1)
                drawn[tail] = self.codes_at(first[tail], second[tail], block[tail], exposure)
            codes[y : y + rows] = drawn
        return codes

    def decide(self, u: Array, photons: Array, exposure: float) -> tuple[Array, Array]:
        """Codes of uniform numbers of 32 bits, and where those do not decide: [...], bool [...] from [...] each."""
        cdf, u = self.cdf(photons, exposure)[..., :-1], u[..., None]
        return np.count_nonzero(u >= cdf, axis=-1), (np.abs(u - cdf) <= 2.0**-32).any(axis=-1)

    def codes_at(self, first: Array, second: Array, photons: Array, exposure: float) -> Array:
        """Codes of single pixels [p] from two words each: a 64-bit number, compared from the nearer end."""
        below, above = (u[:, None] for u in uniform_pair(first, second))
        pmf = self.pmf(photons, exposure)
        cdf, survival = np.cumsum(pmf, axis=1)[:, :-1], np.cumsum(pmf[:, :0:-1], axis=1)[:, ::-1]
        return np.count_nonzero(np.where(below < 0.5, below >= cdf, above <= survival), axis=1)

    def to_dict(self) -> dict[str, Any]:
        """The record as written into files: {"model": name of the class, field: value, ...}."""
        return {"model": type(self).__name__, **asdict(self)}  # type: ignore[call-overload]


def _check_exposure(exposure: float) -> None:
    if not (isfinite(exposure) and exposure > 0):
        raise ValueError(f"exposure is in seconds, finite and above 0, got {exposure!r}")


def _checked(photons: Array, engine: str) -> Array:
    """Photons as an array of frames; `ValueError` for another shape or an unknown engine."""
    photons = np.asarray(photons)
    if photons.ndim not in (2, 3):
        raise ValueError(f"photons have the shape [H, W] or [T, H, W], got {list(photons.shape)}")
    if engine not in ENGINES:
        raise ValueError(f"engine is one of {', '.join(ENGINES)}, got {engine!r}")
    return photons


@cache
def _fast_engine() -> bool:
    """Whether the compiled engine can run here; says so once if it cannot."""
    try:
        from qsim.sensor.compiled.kernel import available
    except ImportError:  # Dr.Jit is not installed
        usable = False
    else:
        usable = available()
    if not usable:
        warnings.warn("no usable LLVM or CUDA: codes are drawn by the NumPy engine, exact but slow", stacklevel=3)
    return usable


def require_number(record: Any, name: str, low: float, high: float = np.inf, *, open_low: bool = False) -> None:
    """ValueError unless the field is a finite number in low ... high (or above low)."""
    value = getattr(record, name)
    number = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    if not (number and isfinite(value) and (value > low if open_low else value >= low) and value <= high):
        least = f"above {low:g}" if open_low else f"at least {low:g}"
        limits = "finite" if low == -np.inf else least if high == np.inf else f"{least} and at most {high:g}"
        raise ValueError(f"{type(record).__name__}.{name} is a number, {limits}; got {value!r}")
    object.__setattr__(record, name, float(value))


def require_bits(record: Any) -> None:
    """ValueError unless the field `bits` is an integer 1 ... 16."""
    try:
        bits = index(record.bits)
    except TypeError:
        bits = 0
    if not 1 <= bits <= 16:
        raise ValueError(f"{type(record).__name__}.bits is an integer 1 ... 16, got {record.bits!r}")
    object.__setattr__(record, "bits", bits)
