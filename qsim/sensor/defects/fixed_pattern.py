"""What makes one pixel differ from the next, and pixels that disturb each other. Everything is off by default.

    Defects (a few numbers)  --draw_maps-->  Maps (one value per pixel)  --sample-->  codes

Maps only change the coefficients of a pixel's light: arrivals = efficiency gain photons + dark dark_rate exposure, so
codes are drawn by the sensor's own cdf. Maps of gain and dark have the mean 1: they spread the signal and do not shift
it. A fixed pattern is fixed: a map is a function of (device seed, row, column) of the full frame, so every frame and
every crop sees the same one. Read noise and offset maps reach into the ADC and are drawn step by step.

Two effects have memory or neighbours: afterpulses (clocked pixels; counting ones are followed by events.py) need the
clip from its first frame, and optical crosstalk needs a margin of one pixel around a crop.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy import ndarray as Array

from qsim.keys import Key, hash_name, uniform, words
from qsim.sensor.distribution import require_number
from qsim.sensor.qis import QIS
from qsim.sensor.sensor import Sensor
from qsim.sensor.spad import SPAD, BinarySPAD

_DEVICE = hash_name("qsim fixed pattern")  # the "clip" of all device maps
_AFTERPULSE, _CROSSTALK = 101, 102  # stages of a clip's key; crosstalk takes one per direction
_DIRECTIONS = ((-1, 0), (1, 0), (0, -1), (0, 1))  # from a pixel to the neighbour that it disturbs

Sampler = Callable[[Sensor, Array, float, Key, tuple[int, int]], Array]  # photons, exposure, key, origin -> codes


@dataclass(frozen=True)
class DarkSpread:
    """Dark rates relative to the median: a log-normal body and a share of hot pixels with a heavy (Pareto) tail.

    The defaults describe the 50 x 50 pixels of a SPAD512 camera in the project's reference data: 18 % spread beyond
    Poisson in the body, 2.2 % of pixels above 3 medians, 1.0 % above 10, the hottest at 370.
    """

    spread: float = 0.18  # standard deviation of the logarithm, of the body
    hot_share: float = 0.022  # of all pixels
    hot_from: float = 3.0  # medians
    hot_to: float = 400.0  # medians
    tail: float = 0.67  # P(rate > x) falls as x^-tail between hot_from and hot_to

    def __post_init__(self) -> None:
        require_number(self, "spread", 0)
        require_number(self, "hot_share", 0, 1)
        require_number(self, "hot_from", 0, open_low=True)
        require_number(self, "hot_to", self.hot_from, open_low=True)
        require_number(self, "tail", 0, open_low=True)

    @property
    def mean(self) -> float:
        """Mean rate over median rate: what a data sheet's median has to be multiplied by to get the sensor's rate."""
        low, high, a = self.hot_from, self.hot_to, self.tail
        norm = low**-a - high**-a
        hot = np.log(high / low) / norm if a == 1 else a / (1 - a) * (high ** (1 - a) - low ** (1 - a)) / norm
        return (1 - self.hot_share) * float(np.exp(self.spread**2 / 2)) + self.hot_share * float(hot)

    def draw(self, u: Array, v: Array) -> Array:
        """Rates over the mean rate, from two uniform numbers per pixel: which kind, and how much."""
        from scipy.special import ndtri

        low, high, a = self.hot_from, self.hot_to, self.tail
        hot = (low**-a - v * (low**-a - high**-a)) ** (-1 / a)
        return np.where(u < self.hot_share, hot, np.exp(self.spread * ndtri(v))) / self.mean


@dataclass(frozen=True)
class Defects:
    """The fixed pattern of a device in a few numbers; `draw_maps` makes it."""

    device_seed: int = 0
    prnu: float = 0.0  # relative standard deviation of the efficiency
    dark: DarkSpread | None = None  # of the dark rate
    dead: float = 0.0  # share of pixels that never fire; placed independently
    offset: float = 0.0  # codes rms, QIS (with `dark`, the dark signal non-uniformity)
    read_noise: float = 0.0  # relative standard deviation of the read noise, QIS

    def __post_init__(self) -> None:
        require_number(self, "prnu", 0, 1)
        require_number(self, "dead", 0, 1)
        require_number(self, "offset", 0)
        require_number(self, "read_noise", 0, 1)


@dataclass(frozen=True, eq=False)
class Maps:
    """One value per pixel [H, W]; None is no map. Measured maps go in here as well."""

    gain: Array | None = None  # efficiency over the sensor's, mean 1
    dark: Array | None = None  # dark rate over the sensor's, mean 1
    dead: Array | None = None  # bool
    offset: Array | None = None  # codes on top of the sensor's
    read_noise: Array | None = None  # over the sensor's, mean 1

    def crop(self, y: int, x: int, height: int, width: int) -> Maps:
        """The maps of a part of the frame."""
        parts = {name: None if m is None else m[y : y + height, x : x + width] for name, m in vars(self).items()}
        return Maps(**parts)


PERFECT = Maps()


def draw_maps(defects: Defects, shape: tuple[int, int], origin: tuple[int, int] = (0, 0)) -> Maps:
    """The maps of one device for the crop [H, W] at `origin` = (y, x); a strength of 0 makes no map."""

    def numbers(name: str, redraw: int = 0) -> Array:
        key = Key(defects.device_seed, _DEVICE, stage=hash_name(name))
        return uniform(words(key, shape, origin, redraw))

    def around_one(name: str, spread: float) -> Array | None:
        """Log-normal factors with the mean 1 and the standard deviation `spread`."""
        from scipy.special import ndtri

        sigma = np.sqrt(np.log1p(spread**2))
        return np.exp(sigma * ndtri(numbers(name)) - sigma**2 / 2) if spread else None

    from scipy.special import ndtri

    return Maps(
        gain=around_one("gain", defects.prnu),
        dark=None if defects.dark is None else defects.dark.draw(numbers("dark"), numbers("dark", 1)),
        dead=numbers("dead") < defects.dead if defects.dead else None,
        offset=defects.offset * ndtri(numbers("offset")) if defects.offset else None,
        read_noise=around_one("read noise", defects.read_noise),
    )


def measured_dark_map(rates: Array) -> tuple[float, Array]:
    """(mean rate, map of mean 1) of measured dark rates [H, W]; `ValueError` for negative or no rates at all."""
    values = np.asarray(rates, float)
    if not (np.isfinite(values).all() and (values >= 0).all() and values.any()):
        raise ValueError("measured dark rates: expected finite numbers, none negative and not all 0")
    return float(values.mean()), values / values.mean()


def sample(
    sensor: Sensor,
    photons: Array,
    exposure: float,
    *,
    key: Key,
    maps: Maps = PERFECT,
    afterpulse: float = 0.0,
    crosstalk: float = 0.0,
    origin: tuple[int, int] = (0, 0),
    margin: tuple[int, int, int, int] = (0, 0, 0, 0),
    engine: str = "auto",
) -> Array:
    """Codes of photons [T, H, W] as `Sensor.sample`, with defects; without any the same bits.

    `afterpulse` is the probability that a plane that fired fires again in the next one for no reason of its own, and
    `crosstalk` that an avalanche sets off one given neighbour of the four. `margin` = rows above, columns left, rows
    below, columns right that `photons` and `maps` have beyond the wanted crop (they are cut off in the end): crosstalk
    needs 1 wherever the crop does not end at the sensor's edge. `origin` is that of `photons`, margin included.
    """
    if afterpulse and key.frame:
        raise ValueError(f"afterpulse has a memory: sample the clip from frame 0, not from frame {key.frame}")
    codes, _ = sample_after(
        None, sensor, photons, exposure, key=key, maps=maps, disturbances=(afterpulse, crosstalk), origin=origin,
        engine=engine,
    )  # fmt: skip
    top, left, bottom, right = margin
    return codes[:, top : codes.shape[1] - bottom, left : codes.shape[2] - right]


def sample_after(
    before: Array | None,
    sensor: Sensor,
    photons: Array,
    exposure: float,
    *,
    key: Key,
    maps: Maps = PERFECT,
    disturbances: tuple[float, float] = (0.0, 0.0),
    origin: tuple[int, int] = (0, 0),
    engine: str | Sampler = "auto",
) -> tuple[Array, Array | None]:
    """As `sample` with `disturbances` = (afterpulse, crosstalk), for a clip that comes in blocks of frames.

    `before` is what the block before this one gave as its second result, None at the clip's first frame. `engine` is
    that of `Sensor.sample`, or a function that draws the codes of pixels without defects in its place.
    """
    afterpulse, crosstalk = disturbances
    for name, value in (("afterpulse", afterpulse), ("crosstalk", crosstalk)):
        if not 0 <= value < 1:
            raise ValueError(f"{name} is a probability below 1, got {value!r}")
    stack = np.asarray(photons)
    if stack.ndim != 3:
        raise ValueError(f"photons have the shape [T, H, W], got {list(stack.shape)}")
    if afterpulse and not isinstance(sensor, BinarySPAD):
        raise ValueError("afterpulse: defined per binary plane; for counting pixels use events.sample, a QIS has none")
    if crosstalk and isinstance(sensor, QIS):
        raise ValueError("crosstalk: a QIS has no avalanches; blur the light instead")
    if isinstance(sensor, BinarySPAD) and sensor.bits > 1 and (afterpulse or crosstalk):
        return _sum_of_planes(before, sensor, stack, exposure, key, maps, disturbances, origin, engine)
    codes = _draw(sensor, stack, exposure, key, maps, origin, engine)
    return _disturb(before, codes, sensor.levels - 1, key, maps, disturbances, origin)


def lit(sensor: Sensor, photons: Array, exposure: float, maps: Maps) -> tuple[Sensor, Array]:
    """A sensor and light [..., H, W] that together have the efficiency and dark rate of every pixel of the maps.

    Dark events become the light that would cause them, so that the sensor's own cdf serves every pixel.
    """
    light = photons if maps.gain is None else photons * maps.gain
    if maps.dark is None:
        return sensor, light
    return _without_dark(sensor), light + maps.dark * (sensor.dark_rate * exposure / sensor.efficiency)


def pmf(sensor: Sensor, photons: Array, exposure: float, maps: Maps) -> Array:
    """P(code) of every pixel of a frame with maps, [..., H, W] -> [..., H, W, levels]; exact, without disturbances."""
    sensor, light = lit(sensor, photons, exposure, maps)
    if maps.offset is None and maps.read_noise is None:
        chances = sensor.pmf(light, exposure)
    elif isinstance(sensor, QIS):
        chances = _read_out_pmf(sensor, light, exposure, maps)
    else:
        raise ValueError(f"{type(sensor).__name__} has no read-out: maps of offset and read noise are for a QIS")
    if maps.dead is not None:
        chances = np.where(maps.dead[..., None], np.arange(sensor.levels) == 0, chances)
    return chances


def _read_out_pmf(sensor: QIS, photons: Array, exposure: float, maps: Maps) -> Array:
    """The law of `QIS.read_out`: sum over electrons n of Pois(n) P(code | n), noise and offset of each pixel."""
    from scipy.special import ndtr, pdtr, pdtrik

    mean = sensor.arrivals(photons, exposure)
    noise = np.broadcast_to(sensor.read_noise * (1.0 if maps.read_noise is None else maps.read_noise), mean.shape)
    offset = np.broadcast_to((0.0 if maps.offset is None else maps.offset) / sensor.gain, mean.shape)
    steps = (np.arange(sensor.levels - 1) + 0.5 - sensor.offset) / sensor.gain
    last = int(np.ceil(pdtrik(1 - 1e-12, max(float(mean.max()), 1e-6)))) + 1
    below, cdf = np.zeros_like(mean), np.zeros((*mean.shape, sensor.levels))
    for n in range(last + 1):
        up_to = pdtr(n, mean) if n < last else np.ones_like(mean)
        electrons = n if sensor.full_well is None else min(n, sensor.full_well)
        with np.errstate(divide="ignore", invalid="ignore"):
            passed = ndtr((steps - (electrons + offset)[..., None]) / noise[..., None])
        exact = sensor.codes_of(electrons + offset)[..., None] <= np.arange(sensor.levels - 1)
        passed = np.where(noise[..., None] > 0, passed, exact)
        cdf[..., :-1] += (up_to - below)[..., None] * passed
        below = up_to
    cdf[..., -1] = 1.0
    return np.diff(cdf, axis=-1, prepend=0.0)


def _draw(
    sensor: Sensor,
    photons: Array,
    exposure: float,
    key: Key,
    maps: Maps,
    origin: tuple[int, int],
    engine: str | Sampler,
) -> Array:
    """Codes [T, H, W] of pixels that differ from each other."""
    sensor, light = lit(sensor, photons, exposure, maps)
    if maps.offset is None and maps.read_noise is None:
        codes = (
            sensor.sample(light, exposure, key=key, origin=origin, engine=engine)
            if isinstance(engine, str)
            else engine(sensor, light, exposure, key, origin)
        )
    elif isinstance(sensor, QIS):
        noise = 1.0 if maps.read_noise is None else maps.read_noise
        offset = 0.0 if maps.offset is None else maps.offset
        codes = np.stack(
            [
                sensor.read_out(frame, exposure, key.at(key.frame + t), origin, noise, offset)
                for t, frame in enumerate(light)
            ]
        )
    else:
        raise ValueError(f"{type(sensor).__name__} has no read-out: maps of offset and read noise are for a QIS")
    return codes if maps.dead is None else np.where(maps.dead, sensor.dtype(0), codes)


def _without_dark(sensor: Sensor) -> Sensor:
    if isinstance(sensor, QIS):
        return replace(sensor, dark_current=0.0)
    if isinstance(sensor, SPAD):
        return replace(sensor, dark_count_rate=0.0)
    raise ValueError(f"{type(sensor).__name__}: unknown to the dark map")


# ---- Memory and neighbours


def _sum_of_planes(
    before: Array | None,
    sensor: BinarySPAD,
    photons: Array,
    exposure: float,
    key: Key,
    maps: Maps,
    disturbances: tuple[float, float],
    origin: tuple[int, int],
    engine: str | Sampler,
) -> tuple[Array, Array | None]:
    """A code as its M planes one after the other, as BinarySPAD draws them, each disturbed by the one before."""
    m, plane = sensor.planes, replace(sensor, bits=1)
    codes = np.zeros(photons.shape, sensor.dtype)
    for p in range(len(photons) * m):
        at = key.at(key.frame * m + p)
        fired = _draw(plane, photons[p // m][None] / m, exposure / m, at, maps, origin, engine)
        fired, before = _disturb(before, fired, 1, at, maps, disturbances, origin)
        codes[p // m] += fired[0]
    return codes, before


def _disturb(
    before: Array | None,
    codes: Array,
    top: int,
    key: Key,
    maps: Maps,
    disturbances: tuple[float, float],
    origin: tuple[int, int],
) -> tuple[Array, Array | None]:
    """Codes [T, H, W] up to `top`, each frame after the one before it; and the memory of the next."""
    if not any(disturbances):
        return codes, None
    result = np.empty_like(codes)
    for t, frame in enumerate(codes):
        at = key.at(key.frame + t)
        fired, before = _plane_after(frame, before, at, maps, disturbances[0], origin)
        result[t] = _crosstalk(fired, top, at, maps, disturbances[1], origin)
    return result, before


def _plane_after(
    plane: Array, before: Array | None, key: Key, maps: Maps, probability: float, origin: tuple[int, int]
) -> tuple[Array, Array]:
    """The plane with afterpulses of the one before, and itself as the memory of the next (before any crosstalk).

    At constant light, P(fire) = p / (1 - a (1 - p)) after some planes: p alone, a the probability.
    """
    if not probability or before is None:
        return plane, plane
    released = uniform(words(replace(key, stage=_AFTERPULSE), plane.shape, origin)) < probability
    after = plane | (before & released.astype(plane.dtype))
    after = after if maps.dead is None else np.where(maps.dead, plane.dtype.type(0), after)
    return after, after


def _crosstalk(codes: Array, top: int, key: Key, maps: Maps, probability: float, origin: tuple[int, int]) -> Array:
    """Each avalanche of a pixel sets off each of its four neighbours with this probability; those go no further.

    A code n brings Binomial(n, probability) avalanches to a neighbour, drawn under the key of the pixel they come from.
    At constant light a plane fires with 1 - (1 - p) (1 - p probability)^4.
    """
    if not probability:
        return codes
    from scipy.special import bdtr

    total = codes.astype(np.int64)
    height, width = codes.shape
    for number, (dy, dx) in enumerate(_DIRECTIONS):
        u = uniform(words(replace(key, stage=_CROSSTALK + number), codes.shape, origin))
        sent, j = np.zeros(codes.shape, np.int64), 0
        while (more := (j < codes) & (u >= bdtr(j, np.maximum(codes, 1), probability))).any():
            sent, j = sent + more, j + 1
        target = (slice(max(dy, 0), height + min(dy, 0)), slice(max(dx, 0), width + min(dx, 0)))
        source = (slice(max(-dy, 0), height + min(-dy, 0)), slice(max(-dx, 0), width + min(-dx, 0)))
        total[target] += sent[source]
    total = np.minimum(total, top)
    return (total if maps.dead is None else np.where(maps.dead, 0, total)).astype(codes.dtype)
