"""Scores a restored clip against the truth: PSNR, a brightness factor per clip, SSIM, intervals over scenes.

    restored x, target x  [T, H, W] or [T, 3, H, W], in units of the peak (photons / peak)  ->  numbers

The peak is 2.5 times the mean light (`data.clips.peak_of`), for every sensor and depth. Output and target are clamped
to [0, 1] and PSNR = 10 log10(1 / MSE) of complete frames, without a border. Few-bit input does not determine the
absolute brightness where the light level is unknown. So every score has two forms: raw, and after the single factor
that is best behind the clamp. A frame whose error lies completely above the peak has no score (NaN); only equal arrays
are infinite. `valid` bool [T, H, W] is false where the target is not known; these pixels count nowhere. Nothing here
imports files, sensors or torch.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import asdict, dataclass, fields
from math import inf, isfinite, nan, pi, sqrt

import numpy as np

from qsim import colour
from qsim.arrays import plain

SSIM_WINDOW = 7  # px; uniform window and sample covariance are the defaults of the field
FACTORS = (0.01, 100.0)  # limits of the search for the best factor
ABOVE_PEAK = 0.05  # share of target pixels above the peak from which a table warns
NEAR_TRUTH = 3.0  # dB; within it, the error of the truth is a large part of a score
CHUNK = 1 << 20  # clamping points evaluated together


@dataclass(frozen=True)
class Score:
    """The score of one clip or one window; decibels are means over the frames that have a score."""

    psnr: float  # dB, raw
    psnr_matched: float  # dB, after the output was multiplied by `scale`
    ssim: float  # raw; NaN below 7 px
    ssim_matched: float  # after `scale`
    scale: float  # best factor, see `best_scale` (mean over windows if matched per window)
    scale_spread: float  # standard deviation of the factor over windows, 0 for one factor per clip
    frames: int  # that have a score
    above_peak: float = 0.0  # share of target pixels above the peak

    def to_dict(self) -> dict[str, float]:
        """Return plain values."""
        return asdict(self)


def _stack(name: str, image: np.ndarray) -> np.ndarray:
    """Return float64 [T, H, W] or [T, 3, H, W]. `ValueError` with the first index of NaN or Inf, or the shape."""
    stack = plain(image, np.float64)
    stack = stack[None] if stack.ndim == 2 else stack
    if stack.ndim not in (3, 4) or stack.size == 0:
        raise ValueError(
            f"{name}: expected [T, H, W] or [T, 3, H, W] with at least one pixel, got shape {np.shape(image)}"
        )
    if not np.isfinite(stack).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(stack))[0])
        axes = "t, y, x" if stack.ndim == 3 else "t, band, y, x"
        raise ValueError(f"{name} is {stack[index]} at ({axes}) = {index}; scores need finite values")
    return stack


def _pair(output: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return output and target as float64 [T, H, W]. `ValueError` if their shapes differ."""
    one = _stack("output", output)
    two = _stack("target", target)
    if one.shape != two.shape:
        raise ValueError(f"output has shape {one.shape}, target {two.shape}; they must be equal")
    return one, two


def decibel(mse: float) -> float:
    """Return the PSNR [dB] of a mean squared error at peak 1; infinite for 0."""
    return colour.psnr(1.0, sqrt(max(mse, 0.0)))


def above_peak(target: np.ndarray, valid: np.ndarray | None = None) -> float:
    """Return the share of (valid) target pixels above the peak, where the clamp hides errors; NaN without any pixel."""
    stack = _stack("target", target)
    over = stack > 1
    keep = _kept(valid, stack)
    if keep is None:
        return float(over.mean())
    return float(over[keep].mean()) if keep.any() else nan


def above_peak_warning(what: str, share: float) -> str:
    """Return the warning of a table in which more than ABOVE_PEAK of the target lies above the peak."""
    return (
        f"Warning: {100 * share:.1f} % of the pixels of {what} lie above the peak, where the clamp hides errors. "
        "A larger peak= counts them."
    )


def _kept(valid: np.ndarray | None, like: np.ndarray) -> np.ndarray | None:
    if valid is None:
        return None
    keep = plain(valid)
    keep = keep[None] if keep.ndim == 2 else keep
    if keep.shape != like.shape or keep.dtype != bool:
        raise ValueError(f"valid: expected bool {list(like.shape)}, got {keep.dtype} {list(keep.shape)}")
    return keep


def psnr(output: np.ndarray, target: np.ndarray, valid: np.ndarray | None = None) -> np.ndarray:
    """Return the PSNR [dB] of every frame, [T], of images [T, H, W] clamped to [0, 1].

    Infinite for equal frames. NaN where frames differ above the peak only, and without a valid pixel.
    """
    one, two = _pair(output, target)
    keep = _kept(valid, two)
    found = []
    for t, (a, b) in enumerate(zip(one, two, strict=True)):
        if keep is not None:
            a = a[keep[t]]
            b = b[keep[t]]
        mse = float(np.mean((np.clip(a, 0, 1) - np.clip(b, 0, 1)) ** 2)) if a.size else nan
        found.append(decibel(mse) if mse > 0 or (a.size and np.array_equal(a, b)) else nan)
    return np.array(found)


def best_scale(output: np.ndarray, target: np.ndarray, valid: np.ndarray | None = None) -> float:
    """Return the factor s in FACTORS with the least clamped error, sum (clip(s O) - clip(G))^2 over all (valid) pixels.

    It is exact: the error is quadratic in s between the points 1/O at which a pixel reaches the peak, and each piece
    gives its least value. 1 where no factor is better than 1, as for a black output.
    """
    one, two = _pair(output, target)
    keep = _kept(valid, two)
    bright = one > 0 if keep is None else (one > 0) & keep
    values = one[bright]
    goal = np.clip(two[bright], 0, 1)

    def error(s: float) -> float:
        return float(np.sum((np.minimum(s * values, 1) - goal) ** 2))

    def refined(s: float) -> float:
        """Least squares over the pixels that s leaves below the peak, free of the rounding of running sums."""
        below = s * values < 1
        square = float(np.sum(values * values, where=below))
        return float(np.sum(values * goal, where=below)) / square if square > 0 else s

    if not values.size or error(1.0) == 0:
        return 1.0
    order = np.argsort(-values)  # the brightest reach the peak first
    values = values[order]
    goal = goal[order]
    found = _least(values, goal)
    low, high = FACTORS
    return min((1.0, found, min(max(refined(found), low), high)), key=error)


def _least(values: np.ndarray, goal: np.ndarray) -> float:
    """Return the factor of the least error over all pieces; `values` > 0 falling, `goal` in [0, 1]."""
    low, high = FACTORS
    white = 0.0  # error of the pixels that are at the peak already
    square, product, rest = (float(np.sum(x)) for x in (values * values, values * goal, goal * goal))
    least = inf
    best = 1.0
    edge = 0.0
    for start in range(0, len(values) + 1, CHUNK):
        v = values[start : start + CHUNK]
        g = goal[start : start + CHUNK]
        edges = 1 / np.maximum(v, 1e-300)
        last = start + CHUNK > len(values)  # the piece in which every pixel is at the peak
        ends = np.append(edges, inf) if last else edges
        starts = np.append(edge, edges)[: len(ends)]
        # Running sums: with each further factor one more pixel reaches the peak and
        # leaves the parabola a s^2 - 2 b s + c for the constant w.
        a, b, c, w = (
            np.append(total, total + sign * np.cumsum(part))
            for total, sign, part in (
                (square, -1, v * v),
                (product, -1, v * g),
                (rest, -1, g * g),
                (white, 1, (1 - g) ** 2),
            )
        )
        square, product, rest, white = (float(x[-1]) for x in (a, b, c, w))
        edge = float(edges[-1]) if len(edges) else edge
        a, b, c, w = (x[: len(ends)] for x in (a, b, c, w))
        with np.errstate(divide="ignore", invalid="ignore"):
            s = np.where(a > 0, b / a, starts)
        # The parabola of a piece counts within that piece alone: its vertex is moved to the nearer end.
        s = np.clip(np.clip(s, starts, ends), low, high)
        inside = (starts <= high) & (ends >= low)
        errors = np.where(inside, w + s * s * a - 2 * s * b + c, inf)
        i = int(np.argmin(errors))
        if errors[i] < least:
            least = float(errors[i])
            best = float(s[i])
    return best


def ssim(output: np.ndarray, target: np.ndarray, valid: np.ndarray | None = None) -> np.ndarray:
    """Return the structural similarity of every frame, [T]: 7 x 7 uniform window, sample covariance, data range 1,
    clamped.

    The mean runs over windows that lie inside the frame (Wang et al. 2004, computed by scikit-image) and hold valid
    pixels only. NaN without such a window, as where a side is below 7 px.
    """
    one, two = (np.clip(image, 0, 1) for image in _pair(output, target))
    keep = _kept(valid, two)
    if min(one.shape[-2:]) < SSIM_WINDOW:
        return np.full(len(one), nan)
    return np.array(
        [_ssim_frame(a, b, None if keep is None else keep[t]) for t, (a, b) in enumerate(zip(one, two, strict=True))]
    )


def _ssim_frame(output: np.ndarray, target: np.ndarray, keep: np.ndarray | None) -> float:
    """Return the SSIM of one frame [H, W]; with `keep` bool [H, W], the mean over windows of kept pixels alone."""
    from scipy.ndimage import minimum_filter
    from skimage.metrics import structural_similarity

    if keep is None:
        axis = None if output.ndim == 2 else 0  # the mean over bands
        return float(structural_similarity(output, target, win_size=SSIM_WINDOW, data_range=1.0, channel_axis=axis))
    index = structural_similarity(output, target, win_size=SSIM_WINDOW, data_range=1.0, full=True)[1]
    edge = SSIM_WINDOW // 2
    inner = (slice(edge, -edge), slice(edge, -edge))
    # A window counts if all of its pixels are kept: the least of them is True.
    kept = index[inner][minimum_filter(keep, SSIM_WINDOW)[inner]]
    return float(kept.mean()) if kept.size else nan


def score(
    output: np.ndarray, target: np.ndarray, *, per_frame_scale: bool = False, valid: np.ndarray | None = None
) -> Score:
    """Return the score of one clip, [T, H, W] in units of the peak; frames without a score are left out of every mean.

    One factor serves the complete clip, because a clip has one light level. `per_frame_scale` gives every frame its
    factor, for the published protocol, which exposes every window separately. The factor is that of the least clamped
    error. It is 1 where the mean over frames would fall or a frame would lose its score, so matched scores are never
    below raw ones.
    """
    return score_and_factors(output, target, per_frame_scale=per_frame_scale, valid=valid)[0]


def score_and_factors(
    output: np.ndarray, target: np.ndarray, *, per_frame_scale: bool = False, valid: np.ndarray | None = None
) -> tuple[Score, np.ndarray]:
    """Return the same score, and the factor of every frame [T] behind its matched numbers."""
    one, two = _pair(output, target)
    keep = _kept(valid, two)
    raw = psnr(one, two, keep)
    if per_frame_scale:
        each = [
            best_scale(a, b, None if keep is None else keep[t]) for t, (a, b) in enumerate(zip(one, two, strict=True))
        ]
        scales = np.array(each)
    else:
        scales = np.full(len(one), best_scale(one, two, keep))
    scaled = one * scales.reshape(-1, *(1,) * (one.ndim - 1))
    matched = psnr(scaled, two, keep)
    if per_frame_scale:
        # Comparisons with NaN are False: a frame without a matched score keeps its raw one.
        worse = ~(matched >= raw)
    else:
        scored = ~np.isnan(raw)
        better = not np.isnan(matched[scored]).any() and _mean(matched[scored]) >= _mean(raw)
        worse = np.full(len(one), not better)
    scales = np.where(worse, 1.0, scales)
    matched = np.where(worse | np.isnan(raw), raw, matched)
    scaled = one * scales.reshape(-1, *(1,) * (one.ndim - 1))
    hidden = np.isnan(raw)
    found = Score(
        psnr=_mean(raw),
        psnr_matched=_mean(matched),
        ssim=_mean(np.where(hidden, nan, ssim(one, two, keep))),
        ssim_matched=_mean(np.where(hidden, nan, ssim(scaled, two, keep))),
        scale=float(scales.mean()),
        scale_spread=float(scales.std()) if per_frame_scale else 0.0,  # rounding alone is no spread
        frames=int(np.count_nonzero(~hidden)),
        above_peak=above_peak(two, keep),
    )
    return found, scales


def mean_score(scores: Sequence[Score]) -> Score:
    """Return the mean of every number over the windows that have one."""
    found = {field.name: _mean(np.array([getattr(s, field.name) for s in scores], float)) for field in fields(Score)}
    return Score(**found)  # type: ignore[arg-type]  # frames become a mean, too


def _mean(values: np.ndarray) -> float:
    """Return the mean of the values that are not NaN; NaN without any."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if known.size else nan


@dataclass(frozen=True)
class Interval:
    """A mean over scenes with its half-width; the half-width is NaN for one scene."""

    mean: float
    half_width: float
    scenes: int


def over_scenes(values: Sequence[float], scenes: Sequence[Hashable], confidence: float = 0.95) -> Interval:
    """Return the mean over scenes and the half-width of Student's interval for it.

    Clips of one scene are averaged first: they are not independent evidence. NaN values (SSIM of tiny frames) are left
    out. Infinite ones (a perfect restoration) make the mean infinite and the half-width unknown.
    """
    if len(values) != len(scenes):
        raise ValueError(f"over_scenes: {len(values)} values but {len(scenes)} scenes")
    groups: dict[Hashable, list[float]] = {}
    for value, scene in zip(values, scenes, strict=True):
        if value == value:
            groups.setdefault(scene, []).append(value)
    means = np.array([sum(group) / len(group) for group in groups.values()])
    if len(means) < 2 or not np.isfinite(means).all():
        return Interval(float(means.mean()) if len(means) else nan, nan, len(means))
    from scipy.stats import t as student

    # Student's interval: the deviation over scenes is itself estimated, from few of them.
    half = float(student.ppf((1 + confidence) / 2, len(means) - 1)) * float(means.std(ddof=1)) / sqrt(len(means))
    return Interval(float(means.mean()), half, len(means))


def clamped_variance(mean: np.ndarray, variance: np.ndarray, peak: float = 1.0) -> np.ndarray:
    """Return the variance of min(X, peak) for normal X, elementwise: the part of a noisy reference in a clamped squared
    error.

    With z = (peak - m)/s, E = m Phi(z) - s phi(z) + peak (1 - Phi(z)) and E2 = (m^2 + s^2) Phi(z) - s (m + peak) phi(z)
    + peak^2 (1 - Phi(z)). The clamp at 0 is left out: counts are positive.
    """
    from scipy.special import ndtr

    spread = np.sqrt(np.maximum(variance, 0))
    safe = np.where(spread > 0, spread, 1.0)
    z = (peak - mean) / safe
    below = ndtr(z)
    density = np.exp(-0.5 * z * z) / sqrt(2 * pi)
    first = mean * below - safe * density + peak * (1 - below)
    second = (mean**2 + safe**2) * below - safe * (mean + peak) * density + peak**2 * (1 - below)
    return np.where(spread > 0, np.maximum(second - first**2, 0), 0.0)


def truth_psnr(errors: Sequence[float]) -> float:
    """Return the PSNR [dB] that a perfect restorer scores against frames with these rms errors (in units of the peak).

    It is the mean over frames, as a score is; infinite where a frame has no error.
    """
    for rms in errors:
        if not isfinite(rms) or rms < 0:
            raise ValueError(f"truth_psnr: an rms error must be a finite number >= 0, got {rms!r}")
    return _mean(np.array([colour.psnr(1.0, rms) for rms in errors]))
