"""Measures the statistics of a stack of frames, block by block in constant memory.

    codes [t, H, W], block after block  ->  histogram, a sample of the codes, and per-pixel sums of x, x^2, x_t x_(t+1)
    and over neighbours

A million frames need as much memory as 256. Codes are integers; float arrays are accepted if every value is integer.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from math import ceil, sqrt

import numpy as np
from numpy import ndarray as Array

from qsim.arrays import plain
from qsim.host import own_numbers

SAMPLED_PIXELS = 1 << 17  # most pixels, and frames, whose codes are kept for a fit of the histograms
SAMPLED_FRAMES = 256


@dataclass(frozen=True, eq=False)
class FrameStatistics:
    """Statistics of T frames at one exposure and one light level."""

    frames: int
    exposure: float  # s
    photons: float | None  # per pixel and exposure by a light standard; 0 is dark, None an unknown steady light
    histogram: Array  # int64 [levels], all pixels and frames
    total: Array  # float64 [H, W], sum of codes over frames
    square: Array  # float64 [H, W], sum of squared codes
    lagged: Array  # float64 [H, W], sum of code(t) code(t + 1)
    first: Array  # float64 [H, W], the first and the last frame
    last: Array
    dispersion: float = float("nan")  # of sums of planes: variance in time over that of a binomial; 1 is expected
    sums: int = 0  # frames of sums that the planes came in
    adjacent: Array | None = None  # float64 [2, H, W], sum of code x code of the pixel below, and of that to the right
    sample: Array | None = None  # codes [t, h, w] of the first frames, of every `stride`-th row and column
    stride: int = 1
    rates: str = ""  # of the codes and of the planes that they sum, in words

    @property
    def pixels(self) -> int:
        """Return H * W."""
        return self.total.size

    @property
    def mean(self) -> float:
        """Return the mean code over pixels and frames."""
        return float(self.total.sum()) / (self.pixels * self.frames)

    @property
    def pixel_variance(self) -> Array:
        """Return the unbiased variance over time of every pixel, codes^2 [H, W]; NaN for a single frame."""
        if self.frames < 2:
            return np.full(self.total.shape, np.nan)
        return np.maximum(self.square - self.total**2 / self.frames, 0) / (self.frames - 1)

    @property
    def variance(self) -> float:
        """Return the mean over pixels of the variance over time, codes^2; NaN for a single frame.

        The fixed pattern does not enter.
        """
        return float(self.pixel_variance.mean())

    @property
    def fixed_pattern(self) -> float:
        """Return the variance between the pixels' expected codes, codes^2; may be negative by noise.

        It is the variance of the pixels' means less the part that noise in time explains.
        """
        if self.pixels < 2 or self.frames < 2:
            return float("nan")
        return float((self.total / self.frames).var(ddof=1)) - self.variance / self.frames

    def central_moment(self, order: int) -> float:
        """Return the central moment of the codes, pooled over pixels and frames, codes^order."""
        codes = np.arange(self.histogram.size, dtype=float)
        share = self.histogram / self.histogram.sum()
        return float(share @ (codes - share @ codes) ** order)

    @property
    def saturated(self) -> float:
        """Return the share of codes at the top level."""
        return float(self.histogram[-1] / self.histogram.sum())

    @property
    def lag_covariance(self) -> float:
        """Return the mean over pixels of the covariance of neighbouring frames, codes^2; NaN below 3 frames.

        It is corrected for the fitted means.
        """
        t = self.frames
        if t < 3:
            return float("nan")
        mean = self.total / t
        products = self.lagged - mean * (2 * self.total - self.first - self.last) + (t - 1) * mean**2
        return float((products / (t - 1)).mean()) + self.variance / t


@own_numbers
def measure(
    blocks: Iterable[Array], *, bits: int, exposure: float, photons: float | None, name: str = "stack"
) -> FrameStatistics:
    """Return the statistics of blocks of frames, each [t, H, W] or [H, W].

    `exposure` in seconds; `photons` per pixel and exposure, 0 for dark frames, None if unknown. `ValueError` naming the
    stack, the frame and the pixel for codes other than integers 0 ... 2^bits - 1. Frames of different sizes and a
    stack without frames are refused too.
    """
    _check_light(exposure, photons, name)
    frames = 0
    sums = None
    stride = 1
    histogram = np.zeros(1 << bits, np.int64)
    sample: list[Array] = []
    for block in blocks:
        codes = as_codes(block, bits, name, frames)
        if bits > 1 and frames < SAMPLED_FRAMES:
            stride = ceil(sqrt(codes[0].size / SAMPLED_PIXELS))
            kept = codes[: SAMPLED_FRAMES - frames, ::stride, ::stride]
            sample.append(kept.astype(np.uint8 if bits <= 8 else np.uint16))
        histogram += np.bincount(codes.ravel(), minlength=histogram.size)
        values = codes.astype(np.float64)
        if sums is None:
            sums = {key: np.zeros(values.shape[1:]) for key in ("total", "square", "lagged")}
            adjacent = np.zeros((2, *values.shape[1:]))
            first = previous = values[0]
        elif values.shape[1:] != previous.shape:
            raise ValueError(f"{name}: frame {frames} is {values.shape[1:]}, the frames before are {previous.shape}")
        else:
            sums["lagged"] += previous * values[0]
        # Sums, squares, and products with the next frame, the next row and the next column
        sums["total"] += values.sum(axis=0)
        sums["square"] += np.einsum("tyx,tyx->yx", values, values)
        sums["lagged"] += np.einsum("tyx,tyx->yx", values[1:], values[:-1])
        adjacent[0, :-1] += np.einsum("tyx,tyx->yx", values[:, 1:], values[:, :-1])
        adjacent[1, :, :-1] += np.einsum("tyx,tyx->yx", values[:, :, 1:], values[:, :, :-1])
        previous = values[-1]
        frames += len(values)
    if sums is None:
        raise ValueError(f"{name}: has no frames")
    total = sums["total"]
    square = sums["square"]
    lagged = sums["lagged"]
    return FrameStatistics(
        frames,
        float(exposure),
        photons,
        histogram,
        total,
        square,
        lagged,
        first,
        previous,
        adjacent=adjacent,
        sample=np.concatenate(sample) if sample else None,
        stride=stride,
    )


def measure_sums(
    blocks: Iterable[Array], *, planes: int, exposure: float, photons: float | None, name: str = "stack"
) -> FrameStatistics:
    """Return the statistics of binary planes from frames [t, H, W] or [H, W] whose values sum `planes` planes.

    `exposure` and `photons` are those of one plane. Only the order of the planes is unknown, so every statistic except
    `lag_covariance` equals that of the planes. `dispersion` needs at least 2 frames. `ValueError` as `measure`; values
    are 0 ... `planes`.
    """
    if planes < 1:
        raise ValueError(f"{name}: sums hold at least 1 plane, got {planes}")
    _check_light(exposure, photons, name)
    ones = None
    squares = None
    frames = 0
    for block in blocks:
        sums = _as_values(block, planes, f"sum of {planes} planes", name, frames).astype(np.float64)
        if ones is None or squares is None:
            ones = np.zeros(sums.shape[1:])
            squares = np.zeros(sums.shape[1:])
        elif sums.shape[1:] != ones.shape:
            raise ValueError(f"{name}: frame {frames} is {sums.shape[1:]}, the frames before are {ones.shape}")
        ones += sums.sum(axis=0)
        squares += np.einsum("tyx,tyx->yx", sums, sums)
        frames += len(sums)
    if ones is None or squares is None:
        raise ValueError(f"{name}: has no frames")
    drawn = frames * planes
    unknown = np.full(ones.shape, np.nan)
    histogram = np.array([ones.size * drawn - ones.sum(), ones.sum()]).astype(np.int64)
    statistics = FrameStatistics(drawn, float(exposure), photons, histogram, ones, ones, unknown, unknown, unknown)
    if frames < 2 or planes < 2:
        return statistics
    # Planes that depend on one another, as by afterpulses, make sums vary more than independent ones.
    observed = float((squares - ones**2 / frames).sum()) / (frames - 1)
    expected = float(statistics.pixel_variance.sum()) * planes
    return replace(statistics, dispersion=observed / expected if expected > 0 else float("nan"), sums=frames)


def _check_light(exposure: float, photons: float | None, name: str) -> None:
    """`ValueError` for an impossible exposure or number of photons."""
    if not (np.isfinite(exposure) and exposure > 0):
        raise ValueError(f"{name}: the exposure is in seconds and above 0, got {exposure!r}")
    if photons is not None and not (np.isfinite(photons) and photons >= 0):
        raise ValueError(f"{name}: photons are a number of at least 0 (0 = dark), got {photons!r}")


def as_codes(block: Array, bits: int, name: str, frame: int) -> Array:
    """Return a block of a stack, from frame number `frame`, as integers [t, H, W]; `ValueError` as `measure`."""
    return _as_values(block, (1 << bits) - 1, f"code of {bits} bits", name, frame)


def _as_values(block: Array, top: int, what: str, name: str, frame: int) -> Array:
    """Return a block of values 0 ... `top` as integers [t, H, W]."""
    block = plain(block)
    block = block[None] if block.ndim == 2 else block
    if block.ndim != 3 or block.size == 0:
        raise ValueError(f"{name}: expected frames [t, H, W] with at least one pixel, got shape {block.shape}")
    wrong = ~((block >= 0) & (block <= top))
    if block.dtype.kind == "f":
        wrong |= block != np.floor(block)
    elif block.dtype.kind not in "uib":
        raise ValueError(f"{name}: expected numbers, got {block.dtype}")
    if wrong.any():
        t, y, x = (int(i) for i in np.argwhere(wrong)[0])
        cure = ""
        if top == 1 and block[t, y, x] > 1:
            cure = "; sums of N binary planes are calibrated with summed=N"
        raise ValueError(
            f"{name}: {block[t, y, x]} at (t, y, x) = ({frame + t}, {y}, {x}) is not a {what}, 0..{top}{cure}"
        )
    return block.astype(np.int64)


def check_noise(darks: Sequence[FrameStatistics], flats: Sequence[FrameStatistics]) -> None:
    """`ValueError` for stacks that determine nothing: flats without a count, and frames that are all alike.

    Dark frames may be alike if a pixel counts nothing: that bounds the dark counts.
    """
    for kind, stacks, bounds in (("dark", darks, True), ("flat", flats, False)):
        for i, stack in enumerate(stacks):
            if not bounds and not stack.total.any():
                raise ValueError(f"calibrate: flat {i} holds no count at all; is it a dark stack, or without light?")
            if alike(stack) and (stack.total.all() or not bounds):
                raise ValueError(
                    f"calibrate: all frames of {kind} {i} are alike, which determines nothing; are they copies of one "
                    "frame, or saturated?"
                )


def alike(stack: FrameStatistics) -> bool:
    """Return whether every pixel has the same code in all of two or more frames."""
    return stack.frames > 1 and not stack.pixel_variance.any()


def check_stacks(darks: Sequence[FrameStatistics], flats: Sequence[FrameStatistics], bits: int) -> None:
    """`ValueError` unless there are stacks, all of one size and of codes of so many bits."""
    if not darks and not flats:
        raise ValueError("calibrate: no frames at all; give dark and flat frames")
    shapes = {stack.total.shape for stack in (*darks, *flats)}
    if len(shapes) > 1:
        raise ValueError(f"calibrate: stacks of different sizes {sorted(shapes)}; use the same part of the sensor")
    for stack in (*darks, *flats):
        if stack.histogram.size != 1 << bits:
            measured = stack.histogram.size.bit_length() - 1
            raise ValueError(
                f"calibrate: bits={bits}, and a stack was measured with bits={measured}; give both the same"
            )
