"""Finds hot pixels in a recording without a map: pixels that do not follow their neighbours over the whole clip.

    codes of up to 16 times  ->  light of each pixel, beside the median of its eight neighbours  ->  map [H, W]

A hot pixel adds its dark counts to whatever passes by. A bright point of the scene does one of three things: it leaves
the pixel, it takes part in what changes around it (a shadow, a lamp that flickers), or nothing changes around it. So a
pixel is **proven** hot if all of this holds:

* over the clip it is brighter than its neighbours, by far more than they are than theirs;
* it is so at every time;
* the light changed on all four sides of it, other than that of the whole frame, and differently on opposite sides;
* its light is not a constant multiple of its neighbours'.

Where nothing moves, and in little light, no pixel is proven alone. There the bright single pixels of the moving part
decide together. If there are enough of them, hardly any leaves its place, and as one they do not follow their
neighbours, they are taken as hot. So are those where nothing moves, unless they are far more than this share explains.
Of a still frame nothing is ever marked: a star stays.

Dead pixels are not looked for: a map has them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy import ndarray as Array
from scipy.fft import dct
from scipy.ndimage import correlate1d, uniform_filter, uniform_filter1d
from scipy.special import expit, logit
from scipy.stats import chi2

from qsim.checks import ArgumentError
from qsim.sensor.estimation import Response
from qsim.settings import setting
from quiver.data.codes import Codes, filled

Wanted = Annotated[
    bool | None,
    setting("recordings: look for hot pixels, which are filled", unset="where no map states them", option="scan"),
]
TIMES = 16  # at which a clip is looked at
FRAMES = 16  # that are averaged at each of them, at most
FEWEST = 6  # times, below which nothing is told
OUTLIER = 5.0  # deviations of the neighbours' own excess, beyond which a pixel stands out
CONSTANT = 0.35  # of its mean, which the excess of a hot pixel has at every time
CHANGED = 1e-4  # chance that still light seems to change on a side
ENOUGH = 5  # bright single pixels in moving parts, from which they decide together
MOSTLY = 0.8  # of the far brighter pixels there that are so at every time, likewise
TOGETHER = 0.5  # of the changes of light around them that they follow, at most, likewise
MANY = 3.0  # of what their share explains where nothing moves: more than this are points of the scene
SURE = 3.0  # deviations
LEAST = 1e-3  # variance of a code [codes^2], at least
SLACK = 1.25  # on the part of a change that light in common explains
FEW_PIXELS = 28  # of such a side; with FEW_COUNTS in them at a time, or less, light is little
FEW_COUNTS = 300
PREDICTED = 31  # px, side of the square in which pixels tell how well neighbours predict a pixel
LIKELY = 0.9  # that a pixel like a hot one is hot, before its own changes are seen
SEEN_BEFORE = 20  # pixels that this belief counts
ROUNDS = 50
NEAR = 5  # px, side of the square of neighbours in little light
WIDE_SIDE = (7, 6)  # px, width and depth of what is compared there
WIDE = 15  # px, side of the square over which motion is averaged
AWAY = 10  # px, from a pixel to the middle of that square on each of its sides
SLOW = 5  # half periods in a clip, up to which changes count
MOVED = 2.0  # of what noise gives, in each of these squares
SIDES = ((3, 2), (7, 4))  # px, width and depth of what is compared on each side of a pixel
AROUND = 9  # px, side of the square of neighbours whose excess is the measure


@dataclass(frozen=True)
class Scan:
    """The hot pixels of a recording."""

    hot: Array  # bool [H, W]
    proven: int  # of them by their own codes; the others stand out where nothing moves
    moving: float  # share of the frame where light moved

    def words(self) -> str:
        """Return what was found, as text."""
        found = int(self.hot.sum())
        if not found:
            return f"no hot pixel found by the scan ({100 * self.moving:.0f} % of the frame moved)"
        rest = found - self.proven
        alike = f", {rest} like them where nothing moves" if rest else ""
        return f"{found} hot pixels found by the scan ({self.proven} do not follow their neighbours{alike})"


def scanned(codes: Codes, wanted: bool | None = None) -> Codes:
    """Return the codes of a recording with the hot pixels filled that a scan finds; the same where a map states them.

    `ArgumentError` if it is `wanted` or unwanted where there is nothing to look for.
    """
    if not codes.unmapped:
        if wanted is not None:
            raise ArgumentError(
                "scan",
                f"acts on recordings without a map of hot pixels, and those of {codes.name} are known; leave it out",
                off=not wanted,
            )
        return codes
    if wanted is False:
        return codes
    found = scan(codes)
    return replace(filled(codes, found.hot), scan=found.words())


def scan(codes: Codes) -> Scan:
    """Return the hot pixels that the codes of a stream prove; none of a clip that is too short.

    Behind colour filters each place of the mask is compared with its own colour.
    """
    length, height, width = codes.shape
    nothing = Scan(np.zeros((height, width), bool), 0, 0.0)
    times = min(TIMES, length)
    rows = 1
    columns = 1
    if codes.colour is not None:
        rows, columns = codes.colour.tile
    # Codes of a schedule are exposed for different times: that changes every pixel, and no scene has moved.
    if times < FEWEST or min(height // rows, width // columns) < AROUND or codes.shares is not None:
        return nothing
    each = min(FRAMES, length // times)
    starts = np.linspace(0, length - each, times).round().astype(int)
    means = np.stack([codes.read(int(t), int(t) + each).mean(axis=0) for t in starts]).astype(np.float32)
    try:
        response = codes.sensor.response(codes.exposure)
    except ValueError:  # codes that do not determine light
        return nothing
    hot = np.zeros((height, width), bool)
    proven = np.zeros((height, width), bool)
    moving = np.zeros((height, width), bool)
    for i in range(rows):
        for j in range(columns):
            place = (slice(i, None, rows), slice(j, None, columns))
            seen = _Seen.of(means[:, *place], response, each)
            proven[place] = seen.proven
            hot[place] = seen.hot
            moving[place] = seen.moving
    return Scan(hot, int(proven.sum()), float(moving.mean()))


@dataclass(frozen=True, eq=False)
class _Seen:
    """What the mean codes of several times tell about the pixels of one colour."""

    stands_out: Array  # bool [H, W]: on the whole, far brighter than its neighbours
    bright: Array  # bool [H, W]: so at every time
    moving: Array  # bool [H, W]: the light around it moves
    apart: Array  # bool [H, W]: does not follow its neighbours
    # [2, 3, H, W], of all changes and of slow ones: what it shares with its neighbours; their changes; noise in these
    followed: Array
    added: Array  # [H, W]: log of the odds that it adds to what passes by, against light that hides it

    @classmethod
    def of(cls, means: Array, response: Response, frames: int) -> _Seen:
        """Return what mean codes [K, H, W] of `frames` codes each tell, by the response of a good pixel."""
        mean_code = response.mean
        variance = response.variance
        ring = _ring(means)
        least = LEAST / frames
        typical = np.maximum(uniform_filter(means.mean(axis=0), 3, mode="reflect"), ring)  # of few counts a median errs
        noise = np.interp(typical, mean_code, variance) / frames + least
        own = np.interp(means.mean(axis=0), mean_code, variance) / frames + least
        # The median of n normal values has about pi / 2 times the variance of their mean: pi / 2 / 8 for eight.
        beside = np.pi / 16 * noise
        excess = means - ring
        mean_excess = excess.mean(axis=0)
        shot = (noise + beside).mean(axis=0) / len(means)
        # What a texture alone makes of a pixel beside its neighbours is measured around it, not assumed.
        spread = np.sqrt(_robust_square(mean_excess) + shot)
        stands_out = mean_excess > OUTLIER * spread
        dark_enough = ring < 0.85 * mean_code[-1]  # beside saturated neighbours no excess is left
        low = excess < CONSTANT * mean_excess - 3 * np.sqrt(own + beside)
        bright = stands_out & ~(low & dark_enough).any(axis=0)
        clean, near, pixels = _without(means, stands_out)
        clean_noise = np.interp(near.mean(axis=0), mean_code, variance) / frames + least
        little = near.mean(axis=0) * frames * FEW_PIXELS < FEW_COUNTS
        around = np.where(little, near, ring)
        own_noise = own.mean(axis=0) if own.ndim == 3 else own
        return cls(
            stands_out,
            bright,
            _moving(means, ring, own) | (little & _moving_in_little_light(clean, clean_noise)),
            ~_follows(means, ring, own, beside),
            _shared(means, around, own, np.where(little, clean_noise / pixels, beside), response),
            _adding(means, stands_out, own_noise, response, frames),
        )

    @property
    def proven(self) -> Array:
        """Pixels that are hot by their own codes, bool [H, W]."""
        return self.bright & self.moving & self.apart

    @property
    def hot(self) -> Array:
        """Pixels that are hot, bool [H, W]: those of `alike` that are more likely so than lamps, given all of them.

        The share of hot pixels among them follows from their own odds, with LIKELY before anything is seen.
        """
        alike = self.alike
        odds = self.added[alike]
        # Expectation maximisation of the share: each pixel's chance by Bayes' rule, then the mean of these chances.
        share = LIKELY
        for _ in range(ROUNDS):
            chance = expit(odds + logit(share))
            share = float((chance.sum() + LIKELY * SEEN_BEFORE) / (len(odds) + SEEN_BEFORE))
        hot = np.zeros_like(alike)
        hot[alike] = odds + logit(share) > 0
        return hot

    @property
    def alike(self) -> Array:
        """Pixels that stay as bright as hot ones, bool [H, W]: the proven, and others if their share explains these."""
        proven = self.proven
        candidates = self.bright & self.moving
        count = int(candidates.sum())
        left = int((self.stands_out & self.moving & ~self.bright).sum())  # bright points of the scene
        if count < ENOUGH or count < MOSTLY * (count + left) or not self._apart_together(candidates):
            return proven
        # Hot pixels lie evenly over the sensor, lamps where the scene has them: in the still part, bright pixels beyond
        # the share of the moving part are lamps. Their number is Poisson, whose deviation is the root of its mean.
        still = int((self.bright & ~self.moving).sum())
        expected = count / int(self.moving.sum()) * int((~self.moving).sum())
        if still > MANY * expected + SURE * np.sqrt(max(expected, 1.0)):
            return candidates
        return self.bright

    def _apart_together(self, candidates: Array) -> bool:
        """Return whether some pixels, taken together, surely follow less than TOGETHER of what changes around them."""
        sums = self.followed[:, :, candidates].sum(axis=2)
        for (shared, around, noise), terms in zip(sums, (TIMES - 1, SLOW), strict=True):
            # Noise adds its mean to a sum of squares; that of n normal values has the relative deviation root(2 / n).
            changes = around - noise
            measured = changes >= SURE * noise * np.sqrt(2 / (int(candidates.sum()) * terms))
            if measured and shared + SURE * np.sqrt(around) < TOGETHER * changes:
                return True
        return False


def _ring(means: Array) -> Array:
    """Return the median of the eight neighbours of every pixel, [K, H, W]; the frame is reflected at its edge."""
    padded = np.pad(means, ((0, 0), (1, 1), (1, 1)), mode="reflect")
    height, width = means.shape[1:]
    near = [
        padded[:, 1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]
        for dy in (-1, 0, 1)
        for dx in (-1, 0, 1)
        if (dy, dx) != (0, 0)
    ]
    return np.asarray(np.median(np.stack(near), axis=0))


def _without(means: Array, out: Array) -> tuple[Array, Array, Array]:
    """Return means [K, H, W] with the mean of the neighbours at pixels that stand out; that mean, and of how many.

    Of few counts the mean of many neighbours tells more than the median of eight.
    """
    good = (~out).astype(float)
    pixels = np.maximum(_box(good, NEAR) - good, 1.0)
    near = (_box(means * good, NEAR) - means * good) / pixels
    return np.where(out, near, means), near, pixels


def _box(values: Array, size: int) -> Array:
    """Return the sums [..., H, W] of squares of `size` pixels around each pixel."""
    sizes = (1,) * (values.ndim - 2) + (size, size)
    return np.asarray(uniform_filter(values, sizes, mode="reflect") * size**2)


def _moving_in_little_light(means: Array, noise: Array) -> Array:
    """Return where light moves, bool [H, W], of means [K, H, W] of a few counts, without pixels that stand out.

    No place tells that alone. So the differences of opposite sides, slow changes only, are squared in units of their
    noise: 1 on average where nothing moves. They are averaged over a square on each of the four sides of a pixel, and
    all of them must have moved. Changes that the neighbourhood shares are taken off.
    """
    width, depth = WIDE_SIDE
    level = _box(means, WIDE) / WIDE**2
    change = level - level.mean(axis=0)
    squares = np.zeros(means.shape[1:])
    for one, other in (((-1, 0), (1, 0)), ((0, -1), (0, 1))):
        sides = [_side(means, *side, width, depth) for side in (one, other)]
        beside = sum(_side(noise[None], *side, width, depth)[0] for side in (one, other)) / (width * depth)
        # Light that falls or rises everywhere changes the difference of two sides in proportion to it: no motion.
        middle = (sides[0] - sides[1]).mean(axis=0)
        left = sides[0] - sides[1] - middle
        most = SLACK * np.abs(middle) / np.maximum(level.mean(axis=0), 1e-6)
        slope = np.clip((change * left).sum(axis=0) / np.maximum((change**2).sum(axis=0), 1e-12), -most, most)
        slow = dct(left - slope * change, axis=0, norm="ortho")[1 : SLOW + 1]
        squares += (slow**2).mean(axis=0) / beside / 2
    # A pixel moves if the squares on all four of its sides did: the least of them counts.
    pooled = _box(squares, WIDE) / WIDE**2
    far = np.pad(pooled, AWAY, mode="reflect")
    height, width = pooled.shape
    sides_of = [
        far[AWAY + dy : AWAY + dy + height, AWAY + dx : AWAY + dx + width]
        for dy, dx in ((-AWAY, 0), (AWAY, 0), (0, -AWAY), (0, AWAY))
    ]
    return np.asarray(np.minimum.reduce(sides_of) > MOVED)


def _adding(means: Array, out: Array, own: Array, response: Response, frames: int) -> Array:
    """Return the log of the odds [H, W] that a pixel is hot, not a lamp of one pixel before what moves.

    A hot pixel sees the scene and adds to it: its light changes as that of its neighbours does, as far as one predicts
    the other in the pixels around. A lamp hides what is behind it: its light does not change with theirs.
    """
    good = (~out).astype(float)
    near = (_box(means * good, 3) - means * good) / np.maximum(_box(good, 3) - good, 1.0)
    level = near.mean(axis=0)
    around = near - level
    change = means - means.mean(axis=0)
    squares = (around**2).sum(axis=0)
    products = (around * change).sum(axis=0)
    pixels = np.maximum(_box(good, PREDICTED), 1.0)

    def ordinary(values: Array) -> Array:
        return np.asarray(_box(values * good, PREDICTED) / pixels)

    # The usual slope of a pixel's change over its neighbours', by least squares over all times and pixels around.
    predicted = np.clip(ordinary(products) / np.maximum(ordinary(squares), 1e-12), 0.0, 1.0)
    left = (change**2).sum(axis=0) - 2 * predicted * products + predicted**2 * squares
    shot = np.interp(level, response.mean, response.variance) / frames
    structure = np.maximum(ordinary(left) / (len(means) - 1) - ordinary(shot), 0.0)
    rise = np.gradient(response.mean, response.photons)
    own_rise = np.interp(means.mean(axis=0), response.mean, rise)
    rise_around = np.interp(level, response.mean, rise)
    factor = own_rise / np.maximum(rise_around, 1e-12)  # codes near the top change less
    slope = predicted * factor
    # Log of the ratio of two normal laws of the same variance, with means slope * around and 0, summed over the times.
    return np.asarray((slope * products - slope**2 * squares / 2) / (own + structure * factor**2))


def _robust_square(values: Array) -> Array:
    """Return the mean square [H, W] of the values of a square around each pixel, which single large ones do not move.

    Values are cut at three times their typical size in the frame's neighbourhood, in two rounds.
    """
    size = np.abs(values)
    limit = 3 * np.maximum(uniform_filter(np.minimum(size, 3 * np.median(size) + 1e-9), AROUND, mode="reflect"), 1e-9)
    for _ in range(2):
        square = uniform_filter(np.minimum(size, limit) ** 2, AROUND, mode="reflect")
        limit = 3 * np.sqrt(square) + 1e-9
    return np.asarray(square)


def _moving(means: Array, ring: Array, own: Array) -> Array:
    """Return where light moves across a pixel, bool [H, W]: it changes on all sides, and differently on opposite ones.

    A change of the whole frame, as at dusk, and one that all neighbours share, as a shadow, are no motion. Sides are
    narrow, or in little light wide.
    """
    # The median of a frame follows the light of the whole scene, and hardly what moves in a part of it.
    whole = np.broadcast_to(np.median(ring, axis=(1, 2))[:, None, None], ring.shape)
    found = [_crossed(means, ring, own, whole, *size) for size in SIDES]
    return np.asarray(np.logical_or.reduce(found))


def _crossed(means: Array, ring: Array, own: Array, whole: Array, width: int, depth: int) -> Array:
    """Return the same by sides of `width` x `depth` pixels."""
    degrees = len(means) - 2  # a mean and a slope are fitted
    sides = {side: _side(means, *side, width, depth) for side in ((-1, 0), (1, 0), (0, -1), (0, 1))}
    noise = {side: _side(own[None], *side, width, depth)[0] / (width * depth) for side in sides}
    changed = [_left(values, whole, noise[side], least=1.0) for side, values in sides.items()]
    across = [
        _left(sides[one] - sides[other], ring, noise[one] + noise[other])
        for one, other in (((-1, 0), (1, 0)), ((0, -1), (0, 1)))
    ]
    # The larger of two squares exceeds its limit twice as often: each has half of the chance.
    different = np.maximum(*across) > chi2.isf(CHANGED / 2, degrees)
    return np.asarray(different & (np.minimum.reduce(changed) > chi2.isf(CHANGED, degrees)))


def _side(means: Array, dy: int, dx: int, width: int, depth: int) -> Array:
    """Return the mean of the pixels on one side of every pixel, `depth` rows of `width`, [K, H, W]."""
    along = 2 if dy else 1
    away = 1 if dy else 2
    rows = np.zeros(2 * depth + 1)
    if dy + dx < 0:
        rows[:depth] = 1 / depth
    else:
        rows[depth + 1 :] = 1 / depth
    mean = uniform_filter1d(means, width, axis=along, mode="reflect")
    return np.asarray(correlate1d(mean, rows, axis=away, mode="reflect"))


def _left(values: Array, law: Array, variance: Array, least: float = 0.0) -> Array:
    """Return chi-square [H, W] of values [K, H, W] about their best fit a + b law.

    b is at most what light that all share explains: as much in proportion as the law, or `least`, with a margin.
    """
    middle = values.mean(axis=0)
    x = law - law.mean(axis=0)
    y = values - middle
    most = SLACK * np.maximum(np.abs(middle) / np.maximum(law.mean(axis=0), 1e-6), least)
    slope = np.clip((x * y).sum(axis=0) / np.maximum((x**2).sum(axis=0), 1e-12), -most, most)
    return np.asarray(((y - slope * x) ** 2 / variance).sum(axis=0))


def _follows(means: Array, ring: Array, own: Array, beside: Array) -> Array:
    """Return where the light of a pixel may be a constant multiple of that of its neighbours, bool [H, W]."""
    # Of y = ratio x, with noise in both, y - ratio x has the variance of y plus ratio^2 times that of x.
    ratio = (means * ring).sum(axis=0) / np.maximum((ring**2).sum(axis=0), 1e-12)
    left = ((means - ratio * ring) ** 2 / (own + ratio**2 * beside)).sum(axis=0)
    return np.asarray(left < chi2.isf(CHANGED, len(means) - 1))


def _shared(means: Array, ring: Array, own: Array, beside: Array, response: Response) -> Array:
    """Return what each pixel has of the changes of its neighbours' light, in units of its noise, [2, 3, H, W].

    They are the sums of change times change, of the neighbours' change squared, and of the noise in that: over all
    frequencies, and over slow ones. Neighbours are scaled to the light of the pixel, whose codes change less the nearer
    they are to the top.
    """
    rise = np.gradient(response.mean, response.photons)
    level = means.mean(axis=0)
    level_around = ring.mean(axis=0)
    light = np.interp(level, response.mean, response.photons)
    around = np.interp(level_around, response.mean, response.photons)
    slope = np.interp(level, response.mean, rise)
    slope_around = np.interp(level_around, response.mean, rise)
    ratio = light / np.maximum(around, 1e-6) * slope / np.maximum(slope_around, 1e-12)
    # The orthonormal cosine transform keeps the variance of white noise and sorts changes by their speed. Its first
    # entry, the mean, is no change.
    expected = dct(ratio * (ring - level_around), axis=0, norm="ortho")[1:]
    change = dct(means - level, axis=0, norm="ortho")[1:]
    noise = np.broadcast_to((ratio**2 * beside).mean(axis=0), change.shape)
    terms = np.stack([change * expected, expected**2, noise])
    return np.stack([terms.sum(axis=1), terms[:, :SLOW].sum(axis=1)]) / own
