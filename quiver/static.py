"""Real photons of a static object: restore from some frames, score against the rest, take off the rest's own noise.

    counts [N, H, W] -> codes of 11 frames (clipped to b bits) -> restored centre frame; the other N - 11 are the truth

Real light flickers a little from frame to frame: every frame is divided by its own share of the light. The reference is
a mean of Poisson counts, with a known variance r / sum(shares); what that adds to the squared error is subtracted, with
the clamp at white taken into account (`metrics.clamped_variance`). The frames are split at random, several times.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan
from pathlib import Path

import numpy as np
from numpy import ndarray as Array

from quiver import metrics
from quiver.data import array_codes, ideal_counter
from quiver.restoring import Restorer

FORMAT = "quiver-static-1"  # of the JSON that `quiver evaluate --static` prints


@dataclass(frozen=True)
class Counts:
    """Photon counts of a static object."""

    frames: Array  # integers [N, H, W]
    shares: Array  # [N]; light of each frame relative to the mean frame
    name: str


@dataclass(frozen=True)
class StaticScore:
    """One method, mean over the splits; the spread is the standard deviation over them."""

    method: str
    psnr: float  # dB, raw, the reference's own variance taken off
    psnr_matched: float  # dB, after the best factor
    psnr_matched_spread: float  # dB
    psnr_as_measured: float  # dB, matched, with the reference's noise still in it
    scale: float
    failure: str | None = None


def read_counts(path: Path) -> Counts:
    """Counts [N, H, W], or [T, K, H, W] with K time gates, from .npy or a .npz with one array.

    With gates a frame's share is its gate's mean, else its own. `ValueError` for anything else than whole counts.
    """
    try:
        loaded = np.load(path, allow_pickle=False)
        array = loaded if isinstance(loaded, np.ndarray) else loaded[loaded.files[0]]
    except (ValueError, EOFError, IndexError) as error:
        raise ValueError(f"{path}: not readable as an array ({error})") from None
    if array.ndim not in (3, 4) or array.size == 0 or not np.issubdtype(array.dtype, np.integer) or array.min() < 0:
        raise ValueError(
            f"{path}: expected whole counts [N, H, W] or [T, K, H, W], got {array.dtype} {list(array.shape)}"
        )
    frames = array.reshape(-1, *array.shape[-2:])
    light = array.mean(axis=(0, 2, 3)) if array.ndim == 4 else array.mean(axis=(1, 2))
    if not light.min() > 0:
        raise ValueError(f"{path}: frame or gate {int(np.argmin(light))} holds no photon at all")
    shares = np.tile(light, len(frames) // len(light)) / light.mean()
    return Counts(frames, shares, path.name)


def reference(counts: Counts, chosen: Array) -> tuple[Array, Array]:
    """Mean photons per frame [H, W] from the chosen frames, and the variance of that estimate."""
    light = float(counts.shares[chosen].sum())
    estimate = counts.frames[chosen].sum(axis=0, dtype=np.int64) / light
    return estimate, estimate / light


def mean_square(output: Array, target: Array, noise: Array) -> float:
    """Mean squared error of clamped images, in units of white, without what the target's variance adds to it."""
    squares = (np.clip(output, 0, 1) - np.clip(target, 0, 1)) ** 2
    return float(squares.mean() - metrics.clamped_variance(target, noise).mean())


def score_split(method: Restorer, counts: Counts, given: Array, bits: int) -> tuple[float, float, float, float]:
    """Raw PSNR, matched PSNR, matched PSNR as measured, and the factor, of one split; `given` frames are restored."""
    sensor, exposure = ideal_counter(bits), 1.0
    codes = np.minimum(counts.frames[given], sensor.levels - 1).astype(np.uint8)
    white, centre = sensor.white(exposure), len(given) // 2
    restored = method.restore(array_codes(codes, sensor, exposure), centre, centre + 1)[0]
    output = restored / (white * float(counts.shares[given].mean()))
    others = np.setdiff1d(np.arange(len(counts.frames)), given)
    target, variance = reference(counts, others)
    target, noise = target / white, variance / white**2
    scale = metrics.best_scale(output, target)
    return (
        metrics.decibel(mean_square(output, target, noise)),
        metrics.decibel(mean_square(scale * output, target, noise)),
        metrics.decibel(mean_square(scale * output, target, np.zeros_like(noise))),
        scale,
    )


def evaluate_static(
    counts: Counts, methods: Sequence[Restorer], *, frames: int = 11, bits: int = 3, splits: int = 3, seed: int = 0
) -> list[StaticScore]:
    """Every method on the same random splits. ValueError if no frame is left for the reference."""
    if not 1 <= frames < len(counts.frames):
        raise ValueError(
            f"{counts.name}: {frames} frames to restore from leave none of {len(counts.frames)} for the reference"
        )
    rng = np.random.default_rng(seed)
    chosen = [np.sort(rng.choice(len(counts.frames), frames, replace=False)) for _ in range(splits)]
    return [_score(method, counts, chosen, bits) for method in methods]


def _score(method: Restorer, counts: Counts, chosen: Sequence[Array], bits: int) -> StaticScore:
    try:
        found = np.array([score_split(method, counts, given, bits) for given in chosen])
    except Exception as error:  # whatever a method dies of is its result
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        return StaticScore(method.name, nan, nan, nan, nan, nan, reason)
    raw, matched, measured, scale = (float(value) for value in found.mean(axis=0))
    return StaticScore(method.name, raw, matched, float(found[:, 1].std()), measured, scale)


def markdown(counts: Counts, scores: Sequence[StaticScore], frames: int, bits: int) -> str:
    """The result as a table."""
    text = [
        f"# Real photons: {counts.name}, restored from {frames} of {len(counts.frames)} frames at {bits} bit",
        "",
        "PSNR in dB, peak = white = the largest code; the variance of the reference is taken off, except where it says "
        "as measured. Matched: after the best factor. ± is the spread over random splits.",
        "",
        "| method | PSNR | PSNR matched | matched, as measured | factor |",
        "|---|---|---|---|---|",
    ]
    for s in scores:
        if s.failure is not None:
            text.append(f"| {s.method} | failed: {s.failure} | | | |")
            continue
        matched = f"{s.psnr_matched:.2f} ± {s.psnr_matched_spread:.2f}"
        text.append(f"| {s.method} | {s.psnr:.2f} | {matched} | {s.psnr_as_measured:.2f} | {s.scale:.3f} |")
    return "\n".join(text) + "\n"
