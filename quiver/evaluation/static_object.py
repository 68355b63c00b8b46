"""Scores methods on real photons of a static object: restores from some frames, the mean of others is the truth.

    counts [N, H, W] -> codes of 11 frames (clipped to b bits) -> restored centre frame; the other N - 11 are the truth

Real light flickers from frame to frame: a restored frame is divided by the mean share of the light of the frames that
its method sees. The reference is a mean of Poisson counts with a known variance r / sum(shares). Its contribution to
the squared error is subtracted, with the clamp at the peak taken into account (`metrics.clamped_variance`). The peak is
2.5 times the mean count, as for clips. The frames are split at random, several times.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isnan, nan

import numpy as np
from numpy import ndarray as Array

from qsim.tables import markdown_table
from quiver.data.clips import peak_of
from quiver.data.codes import Codes, array_codes
from quiver.data.illumination import ideal_clocked, ideal_counter
from quiver.data.photon_counts import Counts, arrivals
from quiver.evaluation import metrics
from quiver.restoration.interface import Restorer

FORMAT = "quiver-static-2"  # of the JSON that `quiver evaluate --static` prints; 1: peak = the largest code


@dataclass(frozen=True)
class StaticScore:
    """The score of one method, mean over the splits; the spread is the standard deviation over them."""

    method: str
    psnr: float  # dB, raw, the reference's own variance taken off
    psnr_matched: float  # dB, after the best factor
    psnr_matched_spread: float  # dB
    psnr_as_measured: float  # dB, matched, with the reference's noise still in it
    scale: float
    above_peak: float = nan  # share of the reference's pixels above the peak
    failure: str | None = None


def reference(counts: Counts, chosen: Array) -> tuple[Array, Array]:
    """Return the mean photons per frame [H, W] of the chosen frames, and the variance of that estimate [H, W].

    Of sums of planes it is the inverse of their saturation, -M log(1 - p), with the variance M p / (n (1 - p)) of n
    sums by the delta method.
    """
    light = float(counts.shares[chosen].sum())
    if counts.sums is not None:
        planes = counts.sums.planes
        estimate = arrivals(counts.frames[chosen].mean(axis=0), planes, len(chosen))
        return estimate * len(chosen) / light, planes * np.expm1(estimate / planes) * len(chosen) / light**2
    estimate = counts.frames[chosen].sum(axis=0, dtype=np.int64) / light
    return estimate, estimate / light


def counted(counts: Counts, bits: int, given: Array | slice = slice(None)) -> Codes:
    """Return the chosen frames as codes of an ideal counter with this many bits, or of sums of planes of a SPAD."""
    if counts.sums is not None:
        clocked = ideal_clocked(counts.sums.planes)
        sums = array_codes(counts.frames[given], clocked, 1.0, counts.name)
        return replace(sums, ppp=counts.light, sensor_name="ideal clocked SPAD")
    _check_bits(counts, bits)
    sensor = ideal_counter(bits)
    codes = np.minimum(counts.frames[given], sensor.levels - 1).astype(np.uint8)
    return replace(array_codes(codes, sensor, 1.0, counts.name), ppp=counts.light, sensor_name="ideal counter")


def _check_bits(counts: Counts, bits: int) -> None:
    if counts.sums is None and not 1 <= bits <= 8:
        raise ValueError(f"{counts.name}: counts are clipped to codes of 1 to 8 bits, got {bits}")


def mean_square(output: Array, target: Array, noise: Array) -> float:
    """Return the mean squared error of clamped images [H, W], in units of the peak, without the target's variance."""
    # E (x - y)^2 = (x - truth)^2 + var y: what the target's own noise adds is taken off.
    squares = (np.clip(output, 0, 1) - np.clip(target, 0, 1)) ** 2
    return float(squares.mean() - metrics.clamped_variance(target, noise).mean())


def _decibel(mse: float) -> float:
    """Return the PSNR [dB]; NaN where no error is left beside the reference's own noise."""
    return metrics.decibel(mse) if mse > 0 else nan


def score_split(
    method: Restorer, counts: Counts, given: Array, bits: int, peak: float
) -> tuple[float, float, float, float, float]:
    """Return raw PSNR, matched PSNR, matched PSNR as measured, the factor and the share above the peak of one split.

    `given` are the frames to restore from, `peak` is in photons.
    """
    # The target is made of the other frames, so that its noise is independent of the method's.
    centre = len(given) // 2
    codes = counted(counts, bits, given)
    first, last = (centre, centre + 1) if method.seamless else (0, len(given))  # a state needs the complete stream
    restored = method.restore(codes, first, last)[centre - first]
    output = restored / (peak * float(counts.shares[given[seen_by(method, centre)]].mean()))
    others = np.setdiff1d(np.arange(len(counts.frames)), given)
    target, variance = reference(counts, others)
    target = target / peak
    noise = variance / peak**2
    scale = metrics.best_scale(output, target)
    return (
        _decibel(mean_square(output, target, noise)),
        _decibel(mean_square(scale * output, target, noise)),
        _decibel(mean_square(scale * output, target, np.zeros_like(noise))),
        scale,
        metrics.above_peak(target),
    )


def seen_by(method: Restorer, frame: int) -> slice:
    """Return the frames that a method sees, at most, to restore one frame of a stream."""
    last = frame + method.look_ahead + 1
    return slice(max(0, last - method.window) if method.seamless else 0, last)


def evaluate_static(
    counts: Counts,
    methods: Sequence[Restorer],
    *,
    frames: int = 11,
    bits: int = 3,
    splits: int = 3,
    seed: int = 0,
    peak: float | None = None,
) -> list[StaticScore]:
    """Score every method on the same random splits, at `peak` photons (default 2.5 times the mean count).

    `ValueError` if no frame is left for the reference, and for codes of more than 8 bits.
    """
    _check_bits(counts, bits)
    if not 1 <= frames < len(counts.frames):
        raise ValueError(
            f"{counts.name}: {frames} frames to restore from leave none of {len(counts.frames)} for the reference"
        )
    rng = np.random.default_rng(seed)
    chosen = [np.sort(rng.choice(len(counts.frames), frames, replace=False)) for _ in range(splits)]
    white = peak_of(counts.light, peak)
    return [_score(method, counts, chosen, bits, white) for method in methods]


def _score(method: Restorer, counts: Counts, chosen: Sequence[Array], bits: int, peak: float) -> StaticScore:
    try:
        found = np.array([score_split(method, counts, given, bits, peak) for given in chosen])
    except Exception as error:  # a method's failure is recorded as its result
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        return StaticScore(method.name, nan, nan, nan, nan, nan, failure=reason)
    raw, matched, measured, scale, above = (float(value) for value in found.mean(axis=0))
    spread = float(found[:, 1].std()) if len(found) > 1 else nan
    return StaticScore(method.name, raw, matched, spread, measured, scale, above)


def markdown(counts: Counts, scores: Sequence[StaticScore], frames: int, bits: int, peak: float | None = None) -> str:
    """Return the result as a Markdown table."""
    above = max((s.above_peak for s in scores if s.failure is None), default=nan)
    depth = f"{bits} bit" if counts.sums is None else counts.sums.words(counts.plane_rate)
    text = [
        f"# Real photons: {counts.name}, restored from {frames} of {len(counts.frames)} frames at {depth}",
        "",
        f"PSNR in dB, peak = {peak_of(counts.light, peak):.4g} photons per pixel"
        + ("" if peak is not None else " (2.5 x mean light)")
        + f", {100 * above:.1f} % of the reference's pixels are above it; the variance of the reference is taken off, "
        "except in the column 'as measured'. Matched: after the factor that is best behind the clamp. ± is the spread "
        "over random splits. n/a: no error is left beside the reference's noise.",
        *([] if not above > metrics.ABOVE_PEAK else ["", metrics.above_peak_warning("the reference", above)]),
        "",
    ]
    table = []
    for s in scores:
        if s.failure is not None:
            table.append([s.method, f"failed: {s.failure}", "", "", ""])
            continue
        spread = "" if isnan(s.psnr_matched_spread) else f" ± {s.psnr_matched_spread:.2f}"
        matched = f"{s.psnr_matched:.2f}{spread}"
        cells = [f"{s.psnr:.2f}", matched, f"{s.psnr_as_measured:.2f}", f"{s.scale:.3f}"]
        table.append([s.method, *("n/a" if cell.startswith("nan") else cell for cell in cells)])
    header = ("method", "PSNR", "PSNR matched", "matched, as measured", "factor")
    return "\n".join([*text, *markdown_table(table, header)]) + "\n"
