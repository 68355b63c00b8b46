"""Measures speed and error of every sensor model and engine and compares them with stated bounds.

    run() -> SensorReport: rows (speed, error of the cdf, chi-square, mismatches, z-scores), hard cases
    SensorReport.ok is false if any number is outside its bounds; speeds count only if required

A correct program meets all bounds: exact forms to rounding, statistics to a false alarm of 1e-6 for the whole
report, compiled codes to 5 in a million.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from math import expm1, log1p, sqrt
from pathlib import Path
from statistics import NormalDist, median
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.figures import new_figure, write_figure
from qsim.files import Progress
from qsim.keys import Key
from qsim.sensor import QIS, BinarySPAD, CountingSPAD, Sensor
from qsim.sensor.compiled import jit, kernel
from qsim.sensor.devices import quiver_physical
from qsim.sensor.sensor import plan_of
from qsim.studies.validation.edge_cases import Case, hard_cases
from qsim.tables import text_table

EXPOSURE = 5e-4  # s, 2000 frames per second
FALSE_ALARM = 1e-6  # of all statistical checks of one report together
CDF_BOUND = {"reference": 1e-10, "fast": 1e-5}  # float64; float32, whose uncertain pixels the reference draws
MISMATCH_BOUND = 5.0  # pixels in a million
FRAME = (512, 1024)  # pixels, of the published data set
ROUNDS = 7  # of timing; the medians count

# Name -> sensor, photons per pixel of timing and histogram, wanted speed in times NumPy's (0: none)
MODELS: dict[str, tuple[Sensor, float, float]] = {
    "QIS 3 bits, gain 1": (QIS(0.8, 1.6, 0.2, 3), 3.25, 25.0),
    "QIS 3 bits, gain 1.077": (QIS(0.8, 1.6, 0.2, 3, gain=3.5 / 3.25), 3.25, 25.0),
    "QIS 3 bits, gain 0.135": (quiver_physical(26.0), 26.0, 8.0),
    "QIS 5 bits, gain 1": (QIS(0.8, 1.6, 0.2, 5), 16.0, 0.0),
    "QIS 3 bits, no read noise": (QIS(0.8, 1.6, 0.0, 3), 3.25, 0.0),
    "clocked SPAD, 1 bit": (BinarySPAD(0.5, 25.0), 0.7, 0.0),
    "clocked SPAD, 7 planes": (BinarySPAD(0.5, 25.0, 3), 4.9, 0.0),
    "counting SPAD, 50 ns": (CountingSPAD(0.5, 25.0, 50e-9, 3), 6.0, 0.0),
    "counting SPAD, tau = T/4": (CountingSPAD(0.5, 25.0, EXPOSURE / 4, 3), 6.0, 0.0),
    "paralyzable, tau = T/4": (CountingSPAD(0.5, 25.0, EXPOSURE / 4, 3, paralyzable=True), 6.0, 0.0),
}
PACKED_TARGET = 3.0  # wanted speed of packed planes in times NumPy's `random < p` and packbits


@dataclass(frozen=True)
class SensorRow:
    """One model on one engine; None where a number does not apply."""

    model: str
    engine: str
    megapixels_per_second: float
    times_numpy: float | None = None  # ratio of the medians of one run
    target: float | None = None  # wanted `times_numpy`
    cdf_error: float | None = None  # largest, against independent sums and integrals
    p_value: float | None = None  # chi-square of the codes against the closed form
    z_mean: float | None = None
    z_variance: float | None = None
    mismatches_per_million: float | None = None  # against the reference engine
    wrong: tuple[str, ...] = ()  # columns outside their bounds


@dataclass(frozen=True)
class SensorReport:
    """The rows of all models, the hard cases and the settings of a run."""

    rows: list[SensorRow]
    cases: list[Case]
    pixels: int
    settings: Mapping[str, object] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        """Whether every number is within its bounds and every hard case is right."""
        return not any(row.wrong for row in self.rows) and all(case.ok for case in self.cases)

    def to_dict(self) -> dict[str, object]:
        """Return the report for JSON."""
        return asdict(self) | {"ok": self.ok}


def run(
    pixels: int = 1 << 22, seed: int = 0, *, require_speed: bool = False, progress: Progress | None = None
) -> SensorReport:
    """Measure all models on about `pixels` pixels, in frames of 512 x 1024 if they suffice; takes a minute."""
    if pixels < 1 << 16:
        raise ValueError(f"pixels: a chi-square and a timing need at least 65536, got {pixels}")
    frames = pixels // FRAME[0] // FRAME[1]
    shape = (frames, *FRAME) if frames else (1, pixels // FRAME[0], FRAME[0])
    checks = 3 * 2 * len(MODELS)
    rows = []
    for n, (name, (sensor, photons, target)) in enumerate(MODELS.items(), 1):
        rows += _measure(name, sensor, photons, target, shape, seed, checks, require_speed)
        if progress is not None:
            progress(n, len(MODELS) + 1)
    rows += _packed(shape, seed, require_speed)
    settings = {"seed": seed, "exposure": EXPOSURE, "fast_engine": jit.available(), "rounds": ROUNDS}
    return SensorReport(
        rows, hard_cases({name: model[0] for name, model in MODELS.items()}, EXPOSURE), int(np.prod(shape)), settings
    )


def _measure(
    name: str,
    sensor: Sensor,
    photons: float,
    target: float,
    shape: tuple[int, ...],
    seed: int,
    checks: int,
    require_speed: bool,
) -> list[SensorRow]:
    """Return the rows of one model: NumPy (for a QIS), the reference, and the compiled engine if it has the model."""
    light = np.full(shape, photons, np.float32)
    key = Key(seed, 1)
    engines = ["reference"]
    if jit.available() and plan_of(sensor, EXPOSURE) is not None:
        engines.append("fast")
    draws: dict[str, Callable[[], Array]] = {
        engine: partial(sensor.sample, light, EXPOSURE, key=key, engine=engine) for engine in engines
    }
    if sensor.has_read_out:
        draws["numpy"] = _numpy_way(sensor, light, seed)
    codes, seconds = _race(draws)
    speed = {engine: light.size / s / 1e6 for engine, s in seconds.items()}
    rows = [SensorRow(name, "numpy", speed["numpy"])] if "numpy" in speed else []
    for engine in engines:
        p, z_mean, z_variance = statistics(codes[engine], sensor, photons)
        ratio = seconds["numpy"] / seconds[engine] if "numpy" in seconds else None
        row = SensorRow(
            name,
            engine,
            speed[engine],
            times_numpy=ratio,
            target=target if engine == "fast" and target else None,
            cdf_error=_cdf_error(sensor, engine),
            p_value=p,
            z_mean=z_mean,
            z_variance=z_variance,
            mismatches_per_million=None
            if engine == "reference"
            else float(np.mean(codes[engine] != codes["reference"]) * 1e6),
        )
        rows.append(judged(row, checks, require_speed))
    return rows


def _packed(shape: tuple[int, ...], seed: int, require_speed: bool) -> list[SensorRow]:
    """Return the rows of packed binary planes: NumPy's `random < p` with packbits, and the compiled engine."""
    if not jit.available():
        return []
    sensor, _, _ = MODELS["clocked SPAD, 1 bit"]
    light = np.full(shape, 0.7, np.float32)
    share = 1 - sensor.cdf(light, EXPOSURE)[..., 0]
    rng = np.random.default_rng(seed)
    draws = {
        "numpy": lambda: np.packbits(rng.random(shape) < share, axis=-1),
        "fast": lambda: sensor.sample_packed(light, EXPOSURE, key=Key(seed, 1)),
    }
    _, seconds = _race(draws)
    name = "clocked SPAD, 1 bit, packed"
    speed = {engine: light.size / s / 1e6 for engine, s in seconds.items()}
    fast = SensorRow(name, "fast", speed["fast"], seconds["numpy"] / seconds["fast"], PACKED_TARGET)
    return [SensorRow(name, "numpy", speed["numpy"]), judged(fast, 1, require_speed)]


def _numpy_way(sensor: Sensor, light: Array, seed: int) -> Callable[[], Array]:
    """Return a function that draws codes in the usual way: Poisson plus Gaussian, rounded and clipped."""
    rng = np.random.default_rng(seed)

    def draw() -> Array:
        electrons = rng.poisson(sensor.arrivals(light, EXPOSURE)) + rng.normal(0, sensor.blur, light.shape)
        return np.clip(np.rint(sensor.gain * electrons + sensor.offset), 0, sensor.levels - 1).astype(sensor.dtype)

    return draw


def _race(draws: dict[str, Callable[[], Array]]) -> tuple[dict[str, Array], dict[str, float]]:
    """Return the results and median seconds of all functions, which run in turns on the same machine."""
    times: dict[str, list[float]] = {name: [] for name in draws}
    codes = {}
    for n in range(ROUNDS + 1):
        for name, draw in draws.items():
            if n == 0 or name != "reference":  # the reference is slow and has no wanted speed: one run is enough
                start = time.perf_counter()
                codes[name] = draw()
                times[name].append(time.perf_counter() - start)
        if n == 0:  # the first round compiled
            times |= {name: [] for name in draws if name != "reference"}
    return codes, {name: median(seconds) for name, seconds in times.items()}


def statistics(codes: Array, sensor: Sensor, photons: float) -> tuple[float, float, float]:
    """Return chi-square p-value, z of mean and z of variance for codes of any shape at constant light [photons]."""
    from scipy.stats import chi2

    pmf = np.exp(sensor.log_pmf(np.array(photons), EXPOSURE))
    counts = np.bincount(codes.ravel(), minlength=pmf.size).astype(float)
    n = codes.size
    frequent = pmf * n >= 5
    observed = np.append(counts[frequent], counts[~frequent].sum())
    expected = np.append(pmf[frequent], pmf[~frequent].sum()) * n
    use = expected >= 5
    impossible = counts[pmf == 0].any()  # pooling must not hide it
    p = (
        0.0
        if impossible
        else float(chi2.sf(((observed - expected)[use] ** 2 / expected[use]).sum(), max(use.sum() - 1, 1)))
    )
    level = np.arange(pmf.size)
    mean = pmf @ level
    variance, fourth = (pmf @ (level - mean) ** power for power in (2, 4))
    z_mean = _z(counts @ level / n - mean, variance / n)
    return p, z_mean, _z(counts @ (level - mean) ** 2 / n - variance, (fourth - variance**2) / n)


def _z(difference: float, variance: float) -> float:
    """Return a difference in standard deviations; infinite for a wrong number without variance."""
    if variance > 0:
        return float(difference / sqrt(variance))
    return 0.0 if difference == 0 else float(np.copysign(np.inf, difference))


def _cdf_error(sensor: Sensor, engine: str) -> float | None:
    """Return the largest error of the cdf over light from 0 to 4 white, against independent sums; None without them."""
    photons = np.linspace(0, 4 * sensor.white(EXPOSURE), 401).astype(np.float32).astype(float)
    expected = _written_out(sensor, photons)
    if expected is None:
        return None
    found = sensor.cdf(photons, EXPOSURE)[:, :-1]
    if engine == "fast":
        plan = plan_of(sensor, EXPOSURE)
        assert plan is not None
        found = kernel.cdf_steps(plan, photons)
        if sensor.sums_planes:  # the kernel compares plane by plane
            expected = np.exp(-sensor.arrivals(photons, EXPOSURE) / (sensor.levels - 1))[:, None]
        found = np.minimum(found, 1)
        expected = np.minimum(expected, 1)
    return float(np.abs(found - expected).max())


def _written_out(sensor: Sensor, photons: Array) -> Array | None:
    """Return F_0 ... by independent formulae, [G] -> [G, levels - 1]; None where there is none."""
    formula = _FORMULAE.get(sensor.code_model)
    if formula is None:
        return None
    return formula(sensor, sensor.arrivals(photons, EXPOSURE)[:, None], np.arange(sensor.levels - 1))


def _by_electrons(sensor: Any, arrivals: Array, k: Array) -> Array:
    """Return F_k of a QIS as a sum over electrons: [G, 1], [levels - 1] -> [G, levels - 1]."""
    from scipy import stats

    n = np.arange(int(arrivals.max() + 12 * sqrt(arrivals.max()) + 60))
    if sensor.read_noise:
        threshold = (k + 0.5 - sensor.offset) / sensor.gain
        below = stats.norm.cdf((threshold - n[:, None]) / sensor.read_noise)
    else:
        below = (sensor.codes_of(n.astype(float))[:, None] <= k).astype(float)
    return np.asarray(stats.poisson.pmf(n, arrivals) @ below)


def _by_planes(sensor: Any, arrivals: Array, k: Array) -> Array:
    """Return F_k of a clocked SPAD by the binomial law of its planes: [G, 1], [levels - 1] -> [G, levels - 1]."""
    from scipy import stats

    return np.asarray(stats.binom.cdf(k, sensor.planes, -np.expm1(-arrivals / sensor.planes)))


def _by_live_time(sensor: Any, arrivals: Array, k: Array) -> Array | None:
    """Return F_k of a counting SPAD by the gamma law of its live time; None for a paralyzable one."""
    from scipy import stats

    if sensor.paralyzable:
        return None
    live = np.maximum(1 - k * sensor.dead_time / EXPOSURE, 0)
    return np.asarray(stats.gamma.sf(arrivals * live, k + 1))


_FORMULAE: dict[str, Callable[[Any, Array, Array], Array | None]] = {
    QIS.code_model: _by_electrons,
    BinarySPAD.code_model: _by_planes,
    CountingSPAD.code_model: _by_live_time,
}


def judged(row: SensorRow, checks: int, require_speed: bool) -> SensorRow:
    """Return the row with the names of its columns that are outside their bounds, among so many `checks`."""
    each = -expm1(log1p(-FALSE_ALARM) / checks)
    limit = NormalDist().inv_cdf(1 - each / 2)
    outside = {
        "cdf error": row.cdf_error is not None and row.cdf_error > CDF_BOUND[row.engine],
        "p": row.p_value is not None and row.p_value < each,
        "z mean": row.z_mean is not None and abs(row.z_mean) > limit,
        "z variance": row.z_variance is not None and abs(row.z_variance) > limit,
        "mismatch": row.mismatches_per_million is not None and row.mismatches_per_million > MISMATCH_BOUND,
        "speed": require_speed and row.target is not None and (row.times_numpy or 0) < row.target,
    }
    return replace(row, wrong=tuple(name for name, wrong in outside.items() if wrong))


# Table and figure


def table(report: SensorReport) -> list[str]:
    """Return the report as lines for a terminal."""
    header = ("model", "engine", "Mpixel/s", "x NumPy", "(target)", "cdf error", "chi2 p", "z mean", "z var", "ppm", "")
    lines = []
    for row in report.rows:
        lines.append(
            (
                row.model,
                row.engine,
                f"{row.megapixels_per_second:.1f}",
                _number(row.times_numpy, ".1f"),
                _number(row.target, ".0f"),
                _number(row.cdf_error, ".1e"),
                _number(row.p_value, ".3f"),
                _number(row.z_mean, "+.1f"),
                _number(row.z_variance, "+.1f"),
                _number(row.mismatches_per_million, ".1f"),
                "OUTSIDE: " + ", ".join(row.wrong) if row.wrong else "",
            )
        )
    cases = [("ok" if case.ok else "WRONG", case.name, case.found) for case in report.cases]
    verdict = "everything is within its bounds" if report.ok else "OUTSIDE the bounds: see the marked lines"
    return [
        *text_table(lines, header, left=2),
        "",
        *text_table(cases, ("", "hard case", "found"), left=3),
        "",
        f"{report.pixels} pixels a draw; {verdict}",
    ]


def _number(value: float | None, style: str) -> str:
    return "-" if value is None else format(value, style)


def figure(report: SensorReport, path: Path) -> None:
    """Write speed against error to `path` (.png, .svg or .pdf), one mark per row that has both."""
    drawn = new_figure(8, 5)
    axes = drawn.add_subplot()
    for engine, marker, colour in (("reference", "o", "#1f5c99"), ("fast", "s", "#c4501b")):
        rows = [row for row in report.rows if row.engine == engine and row.cdf_error is not None]
        x = [row.megapixels_per_second for row in rows]
        y = [max(row.cdf_error or 0.0, 1e-17) for row in rows]
        axes.plot(x, y, marker, color=colour, label=f"{engine} (bound {CDF_BOUND[engine]:.0e})")
        for row, a, b in zip(rows, x, y, strict=True):
            axes.annotate(row.model, (a, b), xytext=(5, 4), textcoords="offset points", fontsize=7)
        axes.axhline(CDF_BOUND[engine], color=colour, linewidth=0.8, linestyle=":")
    axes.set(xscale="log", yscale="log", xlabel="speed [Mpixel/s]", ylabel="largest error of the cdf")
    axes.set_title("Sensor engines: speed against error; codes near a step are decided in float64", fontsize=10)
    axes.legend(frameon=False)
    write_figure(drawn, path)
