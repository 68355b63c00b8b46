"""How close a restored clip is to the truth: PSNR, one brightness factor per clip, SSIM, and intervals over scenes.

    restored x, target x  [T, H, W], in units of the peak (photons / white)  ->  numbers

Output and target are clamped to [0, 1] and PSNR = 10 log10(1 / MSE) of whole frames, no border left out. Few-bit input
does not tell the absolute brightness when the light level is unknown, so every score has two forms: raw, and after the
best single factor. Nothing here knows files, sensors or torch.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import asdict, dataclass
from math import inf, isfinite, log10, nan, pi, sqrt

import numpy as np

SSIM_WINDOW = 7  # px; uniform window and sample covariance are the defaults of the field (spec 5.3)
SSIM_K1, SSIM_K2 = 0.01, 0.03


@dataclass(frozen=True)
class Score:
    """One clip (or one window) scored; decibels are means over frames, `frames` says over how many."""

    psnr: float  # dB, raw
    psnr_matched: float  # dB, after the output was multiplied by `scale`
    ssim: float  # raw; NaN below 7 px
    ssim_matched: float  # after `scale`
    scale: float  # best factor, sum(O G) / sum(O O) (mean over windows if matched per window)
    scale_spread: float  # standard deviation of the factor over windows, 0 for one factor per clip
    frames: int

    def to_dict(self) -> dict[str, float]:
        return asdict(self)


def _stack(name: str, image: np.ndarray) -> np.ndarray:
    """float64 [T, H, W]; ValueError naming the first bad index for NaN or Inf, and for empty or misshaped input."""
    stack = np.asarray(image, dtype=np.float64)
    stack = stack[None] if stack.ndim == 2 else stack
    if stack.ndim != 3 or stack.size == 0:
        raise ValueError(f"{name}: expected [T, H, W] with at least one pixel, got shape {np.shape(image)}")
    if not np.isfinite(stack).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(stack))[0])
        raise ValueError(f"{name} is {stack[index]} at (t, y, x) = {index}; scores need finite values")
    return stack


def _pair(output: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    one, two = _stack("output", output), _stack("target", target)
    if one.shape != two.shape:
        raise ValueError(f"output has shape {one.shape}, target {two.shape}; they must be equal")
    return one, two


def decibel(mse: float) -> float:
    """PSNR [dB] of a mean squared error at peak 1; infinite for 0."""
    return inf if mse <= 0 else -10 * log10(mse)


def psnr(output: np.ndarray, target: np.ndarray) -> np.ndarray:
    """PSNR [dB] of every frame, [T], both inputs clamped to [0, 1]."""
    one, two = _pair(output, target)
    squares = (np.clip(one, 0, 1) - np.clip(two, 0, 1)) ** 2
    return np.array([decibel(float(mse)) for mse in squares.mean(axis=(1, 2))])


def best_scale(output: np.ndarray, target: np.ndarray) -> float:
    """The factor s = sum(O G) / sum(O O) of the least squares |s O - G|, over pixels where the target is not clipped.

    Targets above 1 are left out, because the clamp hides their error: a perfect output then has exactly s = 1.
    Without a positive factor (black output, all of the target clipped) the answer is 1.
    """
    one, two = _pair(output, target)
    inside = two <= 1
    product, square = float(np.sum(one * two, where=inside)), float(np.sum(one * one, where=inside))
    return product / square if square > 0 and product > 0 else 1.0


def _box(image: np.ndarray, size: int) -> np.ndarray:
    """Mean over every size x size window that lies inside, [..., H - size + 1, W - size + 1], by running sums."""
    for axis in (-1, -2):
        image = np.moveaxis(image, axis, -1)
        sums = np.cumsum(np.concatenate([np.zeros((*image.shape[:-1], 1)), image], axis=-1), axis=-1)
        image = np.moveaxis((sums[..., size:] - sums[..., :-size]) / size, -1, axis)
    return image


def ssim(output: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Structural similarity of every frame, [T]: 7 x 7 uniform window, sample covariance, data range 1, clamped inputs.

    The mean runs over windows that lie inside the frame (Wang et al. 2004, as the common libraries compute it). NaN
    where a side is below 7 px: no window fits.
    """
    one, two = (np.clip(image, 0, 1) for image in _pair(output, target))
    if min(one.shape[1:]) < SSIM_WINDOW:
        return np.full(len(one), nan)
    return np.array([_ssim_frame(a, b) for a, b in zip(one, two, strict=True)])


def _ssim_frame(a: np.ndarray, b: np.ndarray) -> float:
    pixels = SSIM_WINDOW**2
    sample = pixels / (pixels - 1)
    mean_a, mean_b = _box(a, SSIM_WINDOW), _box(b, SSIM_WINDOW)
    var_a = sample * (_box(a * a, SSIM_WINDOW) - mean_a**2)
    var_b = sample * (_box(b * b, SSIM_WINDOW) - mean_b**2)
    covariance = sample * (_box(a * b, SSIM_WINDOW) - mean_a * mean_b)
    c1, c2 = SSIM_K1**2, SSIM_K2**2
    luminance = (2 * mean_a * mean_b + c1) / (mean_a**2 + mean_b**2 + c1)
    structure = (2 * covariance + c2) / (var_a + var_b + c2)
    return float(np.mean(luminance * structure))


def score(output: np.ndarray, target: np.ndarray, *, per_frame_scale: bool = False) -> Score:
    """All numbers of one clip, [T, H, W] in units of the peak.

    One factor for the whole clip, because a clip has one light level; `per_frame_scale` gives every frame its own, for
    the published protocol that forces the exposure of every window.
    """
    one, two = _pair(output, target)
    if per_frame_scale:
        scales = np.array([best_scale(a, b) for a, b in zip(one, two, strict=True)])
    else:
        scales = np.full(len(one), best_scale(one, two))
    matched = one * scales[:, None, None]
    return Score(
        psnr=float(psnr(one, two).mean()),
        psnr_matched=float(psnr(matched, two).mean()),
        ssim=float(ssim(one, two).mean()),
        ssim_matched=float(ssim(matched, two).mean()),
        scale=float(scales.mean()),
        scale_spread=float(scales.std()),
        frames=len(one),
    )


@dataclass(frozen=True)
class Interval:
    """A mean over scenes with its half-width; the half-width is NaN for one scene."""

    mean: float
    half_width: float
    scenes: int


def over_scenes(values: Sequence[float], scenes: Sequence[Hashable], confidence: float = 0.95) -> Interval:
    """Mean over scenes and the half-width of Student's interval for it.

    Clips of one scene are averaged first: they are no independent evidence. Not-a-number values (SSIM of tiny frames)
    are left out; infinite ones (a perfect restoration) make the mean infinite and the half-width unknown.
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

    half = float(student.ppf((1 + confidence) / 2, len(means) - 1)) * float(means.std(ddof=1)) / sqrt(len(means))
    return Interval(float(means.mean()), half, len(means))


def clamped_variance(mean: np.ndarray, variance: np.ndarray, peak: float = 1.0) -> np.ndarray:
    """Variance of min(X, peak) for normal X, elementwise: what a noisy reference adds to a clamped squared error.

    With z = (peak - m)/s, E = m Phi(z) - s phi(z) + peak (1 - Phi(z)) and
    E2 = (m^2 + s^2) Phi(z) - s (m + peak) phi(z) + peak^2 (1 - Phi(z)). Clamping at 0 is left out: counts are positive.
    """
    from scipy.special import ndtr

    spread = np.sqrt(np.maximum(variance, 0))
    safe = np.where(spread > 0, spread, 1.0)
    z = (peak - mean) / safe
    below, density = ndtr(z), np.exp(-0.5 * z * z) / sqrt(2 * pi)
    first = mean * below - safe * density + peak * (1 - below)
    second = (mean**2 + safe**2) * below - safe * (mean + peak) * density + peak**2 * (1 - below)
    return np.where(spread > 0, np.maximum(second - first**2, 0), 0.0)


def truth_psnr(rms_error: float) -> float:
    """PSNR [dB] that a perfect restorer scores against a truth with this rms error (in units of the peak)."""
    if not isfinite(rms_error) or rms_error < 0:
        raise ValueError(f"truth_psnr: the rms error must be a finite number >= 0, got {rms_error!r}")
    return decibel(rms_error**2)
