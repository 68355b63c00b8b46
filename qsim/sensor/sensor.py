"""Draws codes from a sensor's exact law by keys, with the reference or the compiled engine, and estimates light.

    expected photons [T, H, W] + key --> codes [T, H, W]

The reference engine draws in NumPy and float64. The compiled engine (compiled/) draws the codes of every sensor that
states a plan for it. The reference draws the few pixels that float32 cannot decide.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, fields
from functools import cache, lru_cache
from math import prod
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy import ndarray as Array

from qsim import plugins
from qsim.arrays import plain
from qsim.keys import Key, require_counters, words, words_at
from qsim.sensor import estimation
from qsim.sensor.compiled.plan import MOST_BITS, Plan
from qsim.sensor.distribution import Distribution, check_exposure
from qsim.sensor.estimation import Estimate, Response
from qsim.sensor.packing import pack

if TYPE_CHECKING:
    from qsim.sensor.compiled.draw_rows import Draw

_CHUNK = 1 << 18  # probabilities in one block of a draw (2 MiB)
SMALLEST = 1 << 14  # pixels of a compiled draw; for fewer, compiling costs more than it saves
MOST_PIXELS = 1 << 31  # of a draw on the device
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


class Sensor(Distribution):
    """A pixel without memory. Subclasses are frozen dataclasses of their parameters.

    What a model can do is stated here, and overridden by the models that can: nobody else asks which model it is.
    """

    sums_planes: ClassVar[bool] = False  # a code is the sum of binary planes, each of which may have its own light
    takes_slices: ClassVar[bool] = False  # light may change within one exposure
    follows_photons: ClassVar[bool] = False  # its photons can be followed one by one: dead time links them
    keeps_charge: ClassVar[bool] = False  # a plane depends on those before it
    has_read_out: ClassVar[bool] = False  # electrons are read with gain, offset and noise
    tabulated: ClassVar[bool] = False  # one number against F_k is a code, or a plane of one: a table can hold the law

    @property
    def plane(self) -> Sensor:
        """The sensor of one binary plane, where a code sums some; else this sensor."""
        return self

    def of_planes(self, planes: int) -> Sensor:
        """Return the same pixel with codes that sum so many binary planes, where codes can be such sums."""
        raise ValueError(f"{type(self).__name__}: only a clocked SPAD sums planes")

    @property
    def gain(self) -> float:
        """Codes per electron or avalanche."""
        return 1.0

    @property
    def offset(self) -> float:
        """The code of no electron."""
        return 0.0

    @property
    def blur(self) -> float:
        """Standard deviation of the noise of reading [electrons]."""
        return 0.0

    def law(self, *, summed: bool = False, disturbed: bool = False, read_out: bool = False) -> str:
        """Return how codes are drawn from random numbers, `drawn_by` of a stream; another law draws other codes.

        "table": one number against the cdf. "process": step by step, or the sum of all planes at once. "planes": one by
        one. "closed form": counting pixels, by their cdf. "spikes": spike cameras, plane after plane. `summed` planes
        have a clip frame each; pixels are `disturbed` by avalanches of others; some have their own `read_out`.
        """
        return "closed form"

    def at_depth(self, bits: int) -> Sensor | None:
        """Return the same pixel with codes of so many bits; None where other parameters belong to its bits."""
        return None

    def without_read_noise(self) -> Sensor:
        """Return the same pixel, read without noise."""
        return self

    def full_well_code(self, sigmas: float) -> int | None:
        """Return the code of the full well less so many sigmas of read noise, at least of half of it; None without."""
        return None

    def __str__(self) -> str:
        """Return the parameters with their units; `repr` is the code that makes this sensor."""
        given = {name: value for name, value in vars(self).items() if value is not None}
        shown = {name: f"{value:.6g}" if isinstance(value, float) else str(value) for name, value in given.items()}
        values = [f"{name} {text} {_UNITS.get(name, '')}".rstrip() for name, text in shown.items()]
        return f"{type(self).__name__} ({self.code_model}): " + ", ".join(values)

    def _repr_pretty_(self, printer: Any, cycle: bool) -> None:
        """Print `str(self)` in a notebook."""
        printer.text(str(self))

    def maximum_likelihood(self, histogram: Array, exposure: float, confidence: float = 0.95) -> Estimate:
        """Return an Estimate of light [photons]: counts of each code [..., levels] -> arrays [...].

        `lower` and `upper` bound the likelihood-ratio interval of this confidence. At all-dark and all-saturated
        histograms the estimate is finite and the bound one-sided (see Estimate). `ValueError` for an empty histogram.
        Where the mean code falls again with light (paralyzable pixels) the answer is the darker of the two.
        """
        return estimation.maximum_likelihood(self, plain(histogram), exposure, confidence)

    def response(self, exposure: float, points: int = estimation.POINTS) -> Response:
        """Return mean and variance of the code at `points` levels of light, and the inverse."""
        return estimation.response(self, exposure, points)

    def with_dark_rate(self, rate: float) -> Sensor:
        """Return this sensor with another dark rate [1/s], for maps of it; a model overrides this."""
        raise ValueError(f"{type(self).__name__}: has no dark rate that a map could change")

    @property
    def counters(self) -> int:
        """Return the frame counters of the random numbers that one code takes; a sum of planes has one per plane."""
        return 1

    def kernel_plan(self, exposure: float) -> Plan | None:
        """Return how a compiled kernel draws the codes of this sensor; None where only the reference draws them.

        A model overrides this to bring its fast form. `plan_of` calls it once per sensor and exposure [s].
        """
        return None

    def sample(
        self, photons: Array, exposure: float, *, key: Key, origin: tuple[int, int] = (0, 0), engine: str = "auto"
    ) -> Array:
        """Return codes of expected photons [H, W], or [T, H, W] = frames key.frame + t; `exposure` in seconds.

        `origin` (y, x) places a crop in the full frame. `engine`: "reference" is NumPy in float64; "fast" is compiled
        (compiled/launch.py) and differs from it in at most 5 pixels per million; "auto" takes the fast one where it can
        run.
        """
        photons = _checked(photons, engine)
        check_exposure(exposure)
        require_counters(key, photons.shape, origin, self.counters)
        plan = None if engine == "reference" else self._usable_plan(photons, exposure)
        if plan is not None:
            from qsim.sensor.compiled import launch

            stack = photons if photons.ndim == 3 else photons[None]
            codes = launch.sample(plan, stack, key, origin, self._exact(stack, exposure, key, origin))
            return codes if photons.ndim == 3 else codes[0]
        if photons.ndim == 2:
            return self._draw_frame(photons, exposure, key, origin)
        codes = np.empty(photons.shape, self.dtype)
        for t, frame in enumerate(photons):
            codes[t] = self._draw_frame(frame, exposure, key.at(key.frame + t), origin)
        return codes

    def blocks(
        self,
        photons: Iterable[Array],
        exposure: float,
        key: Key,
        origin: tuple[int, int] = (0, 0),
        engine: str = "auto",
    ) -> Iterator[Array]:
        """Yield the codes [t, H, W] of successive blocks of photons [t, H, W], the first of frame key.frame."""
        frame = key.frame
        for block in photons:
            yield self.sample(block, exposure, key=key.at(frame), origin=origin, engine=engine)
            frame += len(block)

    def sample_packed(
        self, photons: Array, exposure: float, *, key: Key, origin: tuple[int, int] = (0, 0), engine: str = "auto"
    ) -> Array:
        """Return the codes of `sample` packed by rows: uint8 [..., H, ceil(W bits / 8)], as `packing.pack` makes them.

        The compiled engine joins the bits itself, without a byte per code in between. Crops that do not start at a
        multiple of 4 columns are packed afterwards.
        """
        photons = _checked(photons, engine)
        check_exposure(exposure)
        require_counters(key, photons.shape, origin, self.counters)
        # The compiled engine draws four columns from one block of random words: a crop
        # that begins within such a block would need its first words again.
        direct = engine != "reference" and origin[1] % 4 == 0
        plan = self._usable_plan(photons, exposure) if direct else None
        if plan is None:
            return pack(self.sample(photons, exposure, key=key, origin=origin, engine=engine), self.bits)
        from qsim.sensor.compiled import launch

        stack = photons if photons.ndim == 3 else photons[None]
        exact = self._exact(stack, exposure, key, origin)
        packed = launch.sample_packed(plan, stack, self.bits, key, origin, exact)
        return packed if photons.ndim == 3 else packed[0]

    def sample_on_device(self, photons: Any, exposure: float, *, key: Key, origin: tuple[int, int] = (0, 0)) -> Any:
        """Return the codes of `sample` in the memory of the device that renders: Dr.Jit's tensor uint8 [T, H, W].

        `torch.from_dlpack` makes a torch tensor of it without a copy. Photons [T, H, W] are float32; an array of a
        library that knows DLPack stays on its device. `ValueError` for a sensor or machine without a compiled engine.
        """
        photons = plain(photons) if isinstance(photons, np.ndarray) else photons
        shape = tuple(map(int, photons.shape))
        check_exposure(exposure)
        if len(shape) != 3 or not 0 < prod(shape) <= MOST_PIXELS or "float32" not in str(photons.dtype):
            wanted = "photons have the shape [T, H, W] in float32, 1 to 2^31 of them"
            raise ValueError(f"{wanted}; got {list(shape)} in {photons.dtype}")
        require_counters(key, shape, origin, self.counters)
        if fast_engine_works():
            from qsim.sensor.compiled import jit, on_device

            row = self.device_draw(exposure, key, origin)
            if row is not None and jit.available():
                return on_device.sample(photons.reshape(-1), shape, row, _refuse_wrong)
        raise ValueError(f"{self!r}: no compiled engine draws its codes on this machine; use `sample`")

    def device_draw(
        self, exposure: float, key: Key, origin: tuple[int, int], scale: float = 1.0, at_once: bool = False
    ) -> Draw | None:
        """Return how a kernel draws a row of a batch (rows.py); None without a table of the law.

        `at_once`: a sum of planes is drawn from one number per pixel.
        """
        from qsim.sensor.compiled.draw_rows import Draw
        from qsim.sensor.compiled.row_tables import table_of

        drawn = self if at_once else self.plane
        if not self.tabulated or self.bits > MOST_BITS:
            return None
        table = table_of(drawn, exposure if drawn.law_follows_exposure else 1.0)
        if table is None:
            return None
        planes = 1 if at_once else self.counters
        efficiency = scale * self.efficiency / planes
        return Draw(table, efficiency, self.dark_rate * exposure / planes, planes, key, origin)

    def draw_at(self, photons: Array, exposure: float, *, key: Key, at: Array) -> Array:
        """Return the reference's codes [p] of single pixels: photons [p], `at` int [3, p] = (frame, row, column).

        Rows and columns are those of the full frame. The sensor has at most 8 bits, so that a pixel takes one number.
        """

        def second(undecided: Array) -> Array:
            return words_at(key, at[:, undecided], redraw=1)

        return self.draw(photons, exposure, words_at(key, at), second)

    def _usable_plan(self, photons: Array, exposure: float) -> Plan | None:
        """Return the plan of a compiled draw of these photons; None where the reference has to draw."""
        if not fast_engine_works() or photons.size < max(SMALLEST, 1):
            return None
        from qsim.sensor.compiled import jit

        return plan_of(self, exposure) if jit.available() else None

    def _exact(self, stack: Array, exposure: float, key: Key, origin: tuple[int, int]) -> Callable[[Array], Array]:
        """Return a function: pixels int [3, p] = (t, y, x) of photons [T, H, W] -> the reference's codes [p]."""

        def exact(pixels: Array) -> Array:
            light = np.asarray(stack[tuple(pixels)], np.float64)
            if not (np.isfinite(light) & (light >= 0)).all():
                self.arrivals(stack, exposure)  # names the first wrong pixel
            at = pixels + np.array([[key.frame], [origin[0]], [origin[1]]])
            return self.draw_at(light, exposure, key=key, at=at)

        return exact

    def _draw_frame(self, photons: Array, exposure: float, key: Key, origin: tuple[int, int]) -> Array:
        """Return the reference's codes of one frame [H, W], drawn in blocks of rows."""
        return self._draw_rows(photons, exposure, key, origin, _CHUNK // self.levels)

    def _draw_rows(self, photons: Array, exposure: float, key: Key, origin: tuple[int, int], pixels: int) -> Array:
        codes = np.empty(photons.shape, self.dtype)
        # Blocks of rows bound the memory of the table [pixels, levels]; each
        # pixel has its own number, so their height changes no code.
        rows = max(1, pixels // max(photons.shape[1], 1))
        for y in range(0, photons.shape[0], rows):
            block = np.asarray(photons[y : y + rows], np.float64)
            codes[y : y + rows] = self.draw_block(block, exposure, key, (origin[0] + y, origin[1]))
        return codes

    def draw_block(self, photons: Array, exposure: float, key: Key, origin: tuple[int, int], planes: int = 0) -> Array:
        """Return the reference's codes [H, W] of photons [H, W]; with `planes`, of that many frames: [planes, H, W]."""
        shape = (planes, *photons.shape) if planes else photons.shape

        def second(undecided: Array) -> Array:
            return words(key, shape, origin, redraw=1)[undecided]

        return self.draw(photons, exposure, words(key, shape, origin), second)

    def to_dict(self) -> dict[str, Any]:
        """Return the record as files store it: {"model": name of the class, field: value, ...}.

        Of a class of others, `plugin` states module, version and digest.
        """
        return {"model": type(self).__name__, **asdict(self), **plugins.stated(type(self))}  # type: ignore[call-overload]

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Pickle a class of a named file by its source: another process has the module under no name."""
        if not plugins.is_of_file(type(self)):
            return super().__reduce_ex__(protocol)
        values = {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]
        return plugins.made_again, (type(self).__name__, plugins.stated(type(self))["plugin"], values)


def _checked(photons: Array, engine: str) -> Array:
    """Return photons as an array of frames; `ValueError` for another shape or an unknown engine."""
    photons = plain(photons)
    if photons.ndim not in (2, 3):
        raise ValueError(f"photons have the shape [H, W] or [T, H, W], got {list(photons.shape)}")
    if engine not in ENGINES:
        raise ValueError(f"engine is one of {', '.join(ENGINES)}, got {engine!r}")
    return photons


def _refuse_wrong(light: Array, pixels: Array) -> None:
    """Raise `ValueError` with the first photons [p] that no sensor can see; `pixels` int [3, p] = (t, y, x)."""
    wrong = ~(np.isfinite(light) & (light >= 0))
    if wrong.any():
        where = pixels[:, wrong][:, 0].tolist()
        raise ValueError(f"photons{where} is {float(light[wrong][0])!r}; expected photons are finite and not negative")


@lru_cache(maxsize=32)
def plan_of(sensor: Sensor, exposure: float) -> Plan | None:
    """Return `sensor.kernel_plan(exposure)`, made once: a kernel is traced for each plan object."""
    return sensor.kernel_plan(exposure)


@cache
def fast_engine_works() -> bool:
    """Return whether the compiled engine can run on this machine; warn once if it cannot."""
    try:
        from qsim.sensor.compiled import jit

        usable = jit.available()
    except ImportError:  # Dr.Jit is not installed
        usable = False
    if not usable:
        warnings.warn("no usable LLVM or CUDA: codes are drawn by the NumPy engine, exact but slow", stacklevel=5)
    return usable
