"""Models clocked single-photon avalanche diodes (BinarySPAD), and the base shared with CountingSPAD.

Avalanches that the pixel could detect are a Poisson process. An exposure expects PDE photons + dark_count_rate exposure
of them, called arrivals.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy import ndarray as Array

from qsim.keys import Key, normal, require_counters, uniform_pair, words
from qsim.sensor.code_search import search
from qsim.sensor.compiled.plan import MOST_BITS, Live, Plan
from qsim.sensor.distribution import MOST_EVENTS, require_bits, require_number, require_size
from qsim.sensor.sensor import Sensor

_PLANES_BITS = 8  # of a sum drawn plane by plane; above it, the sum is drawn from one number
_BATCH = 1 << 17  # words of a batch of planes


@dataclass(frozen=True)
class SPAD(Sensor):
    """The parameters of both kinds of pixel: avalanches per photon, and avalanches in the dark."""

    pde: float  # avalanches per photon, 0 ... 1
    dark_count_rate: float  # 1/s

    def __post_init__(self) -> None:
        require_number(self, "pde", 0, 1, open_low=True)
        require_number(self, "dark_count_rate", 0)
        require_bits(self)
        require_size(self, "pde", 1e-12, 1.0)
        require_size(self, "dark_count_rate", 1e-30, MOST_EVENTS)

    @property
    def efficiency(self) -> float:
        return self.pde

    @property
    def dark_rate(self) -> float:
        return self.dark_count_rate

    def with_dark_rate(self, rate: float) -> Self:
        return replace(self, dark_count_rate=rate)

    def white(self, exposure: float) -> float:
        """Return the largest code / PDE.

        This light would fill the code if every plane could count, and no pixel were ever dead.
        """
        return (self.levels - 1) / self.pde


@dataclass(frozen=True)
class BinarySPAD(SPAD):
    """A clocked pixel: one plane is 1 if anything arrived; a code is the sum of M planes, by default 2^bits - 1.

    **Planes are drawn one by one**, up to 8 bits. Frame f of a b-bit stream is the sum of planes f M ... f M + M - 1,
    and plane p is the code that a 1-bit sensor draws for frame p of the same key. So two bit depths of one plane rate
    use the same photons: seven frames of the 1-bit stream add up to one frame of the 3-bit stream. This holds at
    constant light. With `sample_planes` it holds at any number of bits, each plane having its own instant of the
    motion. Above 8 bits `sample` draws the binomial sum from one number per pixel: 65 535 planes would take 2.5 ms.
    """

    bits: int = 1  # 1 ... 16
    summed: int | None = None  # planes of a code, where they are fewer than 2^bits - 1

    code_model: ClassVar[str] = "binary_sum"
    sums_planes: ClassVar[bool] = True
    tabulated: ClassVar[bool] = True
    law_follows_exposure: ClassVar[bool] = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.summed is None:
            return
        if not isinstance(self.summed, int) or self.summed.bit_length() != self.bits:
            least = 1 << (self.bits - 1)
            raise ValueError(
                f"BinarySPAD.summed: a code of {self.bits} bits sums {least} to {2 * least - 1} planes, "
                f"got {self.summed!r}"
            )
        if self.summed == (1 << self.bits) - 1:
            object.__setattr__(self, "summed", None)  # one sensor has one form

    def __repr__(self) -> str:
        values = (f"{name}={value!r}" for name, value in vars(self).items() if value is not None)
        return f"{type(self).__name__}({', '.join(values)})"

    @property
    def planes(self) -> int:
        """Return the number of binary planes in one code, M = 2^bits - 1 unless `summed` is given."""
        return (1 << self.bits) - 1 if self.summed is None else self.summed

    @property
    def levels(self) -> int:
        """Return the number of codes, M + 1."""
        return self.planes + 1

    @property
    def plane(self) -> BinarySPAD:
        return replace(self, bits=1, summed=None)

    def of_planes(self, planes: int) -> BinarySPAD:
        """Return the same pixel with codes that sum so many binary planes, 1 ... 65535."""
        return replace(self, bits=planes.bit_length(), summed=planes)

    def at_depth(self, bits: int) -> BinarySPAD:
        return replace(self, bits=bits, summed=None)

    def to_dict(self) -> dict[str, Any]:
        found = super().to_dict()
        if self.summed is None:
            found.pop("summed")
        return found

    def law(self, *, summed: bool = False, disturbed: bool = False, read_out: bool = False) -> str:
        return "planes" if summed or disturbed or self.bits <= _PLANES_BITS else "process"

    @property
    def counters(self) -> int:
        return self.planes if self.bits <= _PLANES_BITS else 1

    def cdf_of(self, arrivals: Array, exposure: float) -> Array:
        cdf = np.minimum(np.cumsum(np.exp(self.log_pmf_of(arrivals, exposure)), axis=1), 1.0)
        cdf[:, -1] = 1.0
        return cdf

    def log_pmf_of(self, arrivals: Array, exposure: float, wanted: Array | None = None) -> Array:
        """Return log of Binomial(M, p) with p = 1 - exp(-arrivals / M): [p] -> [p, levels]."""
        from scipy.special import xlogy

        k = np.arange(self.levels)
        per_plane = arrivals[:, None] / self.planes
        return _log_binomials(self.planes) + xlogy(k, -np.expm1(-per_plane)) - (self.planes - k) * per_plane

    def code_laws(self, codes: Array, arrivals: float, exposure: float) -> tuple[Array, Array]:
        from scipy.special import gammaln

        m = self.planes
        per_plane = arrivals / self.planes
        # Binomial(M, p) at p = 1 - exp(-x), x = arrivals / M: log C(M, k) + k log p - (M - k) x.
        ways = gammaln(m + 1) - gammaln(codes + 1) - gammaln(m - codes + 1)
        logs = ways + codes * np.log(-np.expm1(-per_plane)) - (m - codes) * per_plane
        return logs, (codes / np.expm1(per_plane) - (m - codes)) / m

    def moments_of(self, arrivals: Array, exposure: float) -> tuple[Array, Array]:
        if not self.many_codes:
            return self.dense_moments_of(arrivals, exposure)
        per_plane = arrivals / self.planes
        mean = -self.planes * np.expm1(-per_plane)
        return mean, mean * np.exp(-per_plane)

    def slope_of(self, arrivals: Array, exposure: float) -> Array:
        """Return dF_k/dp dp/darrivals: -M C(M-1, k) p^k (1-p)^(M-1-k) times (1-p) / M."""
        from scipy.special import xlogy

        k = np.arange(self.planes)
        per_plane = arrivals[:, None] / self.planes
        log_slope = _log_binomials(self.planes - 1) + xlogy(k, -np.expm1(-per_plane)) - (self.planes - k) * per_plane
        return np.pad(-np.exp(log_slope), ((0, 0), (0, 1)))

    def kernel_plan(self, exposure: float) -> Plan | None:
        """Return the plan of F_0 = exp(-arrivals / M) in each of M planes."""
        if self.bits > MOST_BITS:
            return None
        m = self.planes
        return Plan.summed(self.efficiency / m, self.dark_rate * exposure / m, Live(2, (1.0,)), planes=m)

    def sample_planes(
        self,
        photons: Array,
        exposure: float,
        *,
        key: Key,
        origin: tuple[int, int] = (0, 0),
        engine: str = "auto",
    ) -> Array:
        """Return codes [T, H, W] of a clip at the plane rate: photons [T M, H, W] and exposure [s] of each plane."""
        if photons.ndim != 3 or len(photons) % self.planes:
            raise ValueError(
                f"planes of a {self.bits}-bit code come in groups of {self.planes}: [T {self.planes}, H, W], "
                f"got {list(photons.shape)}"
            )
        require_counters(key, (len(photons) // self.planes, *photons.shape[1:]), origin, self.planes)
        # Plane p of all planes has the random numbers of frame p of a 1-bit
        # sensor: two depths of one plane rate share their photons.
        single = self.plane
        codes = np.empty((len(photons) // self.planes, *photons.shape[1:]), self.dtype)
        for t in range(len(codes)):
            group = photons[t * self.planes : (t + 1) * self.planes]
            at = key.at((key.frame + t) * self.planes)
            codes[t] = single.sample(group, exposure, key=at, origin=origin, engine=engine).sum(axis=0)
        return codes

    def _draw_frame(self, photons: Array, exposure: float, key: Key, origin: tuple[int, int]) -> Array:
        if self.bits <= _PLANES_BITS:
            return self._draw_planes(photons, exposure, key, origin)
        return self._draw_sum(photons, exposure, key, origin)

    def _draw_sum(self, photons: Array, exposure: float, key: Key, origin: tuple[int, int]) -> Array:
        """Return the smallest code k with u < P(Binomial(M, p) <= k) for each pixel [H, W]; u has 64 bits.

        Error: that of the regularised beta function, below 1e-11 in any probability (tested at 9 and 16 bits).
        """
        from scipy.special import betainc

        below, above = (u.ravel() for u in uniform_pair(*(words(key, photons.shape, origin, n) for n in (0, 1))))
        m = self.planes
        per_plane = self.arrivals(photons, exposure).ravel() / self.planes
        dark = np.exp(-per_plane)
        lit = -np.expm1(-per_plane)

        def passed(k: Array, left: Array) -> Array:
            q = dark[left]
            p = lit[left]
            u = below[left]
            v = above[left]
            low = u < 0.5
            # P(Binomial(M, p) <= k) = I_(1-p)(M - k, k + 1), the regularised beta function. It is compared on
            # the side where the probability is small, so that tails of 1e-19 keep their digits.
            tail = betainc(np.where(low, m - k, k + 1.0), np.where(low, k + 1.0, m - k), np.where(low, q, p))
            return np.where(low, u >= tail, v <= tail)

        # The normal approximation, from which the search takes a few steps.
        z = normal(below, above)
        guess = m * lit + z * np.sqrt(m * lit * dark)
        return search(passed, m, np.rint(guess)).reshape(photons.shape).astype(self.dtype)

    def _draw_planes(self, photons: Array, exposure: float, key: Key, origin: tuple[int, int]) -> Array:
        """Return codes [H, W] as sums of planes, drawn in blocks of planes and rows that share their light.

        Error: the rounding of one exponential, 1e-16 in the probability of each plane, at any number of bits.
        """
        single = self.plane
        m = self.planes
        codes = np.zeros(photons.shape, self.dtype)
        rows = max(1, _BATCH // max(photons.shape[1] * m, 1))
        for y in range(0, len(photons), rows):
            light = np.asarray(photons[y : y + rows], np.float64) / m
            step = max(1, _BATCH // max(light.size, 1))
            for plane in range(0, m, step):
                at = key.at(key.frame * m + plane)
                place = (origin[0] + y, origin[1])
                fired = single.draw_block(light, exposure / m, at, place, planes=min(step, m - plane))
                codes[y : y + rows] += fired.sum(axis=0, dtype=self.dtype)
        return codes

    def draw_at(self, photons: Array, exposure: float, *, key: Key, at: Array) -> Array:
        """As every sensor: the sum of the planes, where plane p of frame f is frame f M + p of a 1-bit sensor."""
        if self.bits == 1:
            return super().draw_at(photons, exposure, key=key, at=at)
        single = self.plane
        m = self.planes
        first = at * np.array([[m], [1], [1]])
        planes = (first + np.array([[plane], [0], [0]]) for plane in range(m))
        return np.sum([single.draw_at(photons / m, exposure / m, key=key, at=plane) for plane in planes], axis=0)


def _log_binomials(n: int) -> Array:
    """Return log C(n, k), k = 0 ... n."""
    from scipy.special import gammaln

    k = np.arange(n + 1)
    return gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1)
