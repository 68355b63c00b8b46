"""Restores streams whose codes have different exposures: three methods that know the exposure of every code.

    naive       sum of (codes - dark) over the codes below saturation / sum of their exposures
    moment      the light at which the expected sum of all codes of a window is the one that was read
    likelihood  the light that makes all codes of a window most likely

Light is that of a full exposure. Where all codes are saturated, the answer ends where the shortest exposure resolves
nothing more. Saturated codes of long exposures tell `moment` and `likelihood` that the light is at least that bright;
`naive` leaves them out. Both are corrected for the bias of curved responses (few_codes.py), and all are negative below
the codes of a dark pixel. Sources: textbook; weighting by exposure as for merging bracketed photographs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import lru_cache

import numpy as np
from numpy import ndarray as Array

from qsim.sensor.estimation import pieces
from qsim.sensor.sensor import Sensor
from quiver.baselines import few_codes
from quiver.baselines.few_codes import levels, times_of
from quiver.baselines.naive_mean import dark_codes
from quiver.baselines.sliding_window import check_window, checked_codes, existing_frames, in_units

CHUNK = 1 << 22  # likelihoods, and entries of histograms, held at a time
TABLE_BYTES = 1 << 28  # most of a table of likelihoods: 3 exposures of 12 bits
FEW_BITS = 8  # up to which only the top code counts as saturated: of few codes none is spared near the full well
SCATTER = 4.0  # deviations of the read noise below the full well, from which on codes of more bits are saturated

Estimate = Callable[[Array, Array, Sensor, float], Array]  # codes [window, N], their shares, ... -> photons [N]


def restore(
    codes: Array,
    sensor: Sensor,
    exposure: float,
    shares: Array,
    *,
    method: str = "likelihood",
    window: int = 11,
    photons_per_unit: float = 1.0,
    frames: range | None = None,
) -> Array:
    """Restore codes [T, H, W] with exposures `shares` [T] of `exposure` [s]: float32 [T, H, W], of full exposures.

    `window` frames around each are used. `ValueError` for codes that the sensor cannot produce, an empty window, and a
    method without exposures.
    """
    codes = checked_codes(codes, sensor)
    check_window(window)
    if method not in METHODS:
        raise ValueError(f"method {method!r}: takes equal exposures only; use {', '.join(METHODS)} for this stream")
    frames = range(len(codes)) if frames is None else frames
    restored = np.empty((len(frames), *codes.shape[1:]), np.float32)
    for i, frame in enumerate(frames):
        taken = existing_frames(frame, window, len(codes))
        seen = codes[taken].reshape(-1, codes[0].size)
        restored[i] = METHODS[method](seen, shares[taken], sensor, exposure).reshape(codes.shape[1:])
    return in_units(restored, photons_per_unit)


def naive(codes: Array, shares: Array, sensor: Sensor, exposure: float) -> Array:
    """Return photons [N] of codes [window, N]: the mean of the codes below saturation, weighted by their exposures."""
    step = sensor.white(exposure) / (sensor.levels - 1)
    dark = np.array([dark_codes(sensor, exposure * share) for share in shares])
    open_ = codes < _saturated(sensor)
    open_[np.argmin(shares)] |= ~open_.any(axis=0)  # all saturated: the shortest exposure alone
    signal = np.where(open_, codes - dark[:, None], 0.0).sum(axis=0)
    return np.asarray(signal * step / (shares[:, None] * open_).sum(axis=0))


def _saturated(sensor: Sensor) -> int:
    """Return the lowest code that counts as saturated: the top code, or of many bits one near the full well.

    Read noise is added behind the full well, so that saturated codes scatter around that of the full well. However
    strong it is, the lower half of the full well counts as light.
    """
    near = sensor.full_well_code(SCATTER) if sensor.bits > FEW_BITS else None
    return sensor.levels - 1 if near is None else near


def moment(codes: Array, shares: Array, sensor: Sensor, exposure: float) -> Array:
    """Return photons [N] of codes [window, N]: the light whose expected sum is theirs, through the exact responses."""
    return few_codes.of_sums(sensor, exposure, times_of(shares))[codes.sum(axis=0, dtype=np.int64)]


def likelihood(codes: Array, shares: Array, sensor: Sensor, exposure: float) -> Array:
    """Return the most likely photons [N] of codes [window, N] less their bias; saturated codes are no gaps."""
    times = times_of(shares)
    distinct, kinds = np.unique(shares, return_inverse=True)
    if len(distinct) == 1 and few_codes.counts_suffice(sensor):
        return moment(codes, shares, sensor, exposure)
    if few_codes.outcome_shape(sensor, times) is not None:
        outcome = tuple(codes[kinds == kind].sum(axis=0, dtype=np.int64) for kind in range(len(distinct)))
        return few_codes.of_outcomes(sensor, exposure, times)[outcome]
    sums = codes.sum(axis=0, dtype=np.int64)
    return few_codes.less_bias(likeliest(codes, shares, sensor, exposure), sums, sensor, exposure, times)


def likeliest(codes: Array, shares: Array, sensor: Sensor, exposure: float) -> Array:
    """Return the most likely photons [N] of codes [window, N], on `levels` and by a parabola through the best three.

    They err by less than 1e-3 of the light; those of saturated codes only are the last level.
    """
    distinct, kinds = np.unique(shares, return_inverse=True)
    light = levels(tuple(distinct), sensor, exposure)
    table = log_pmf(tuple(distinct), sensor, exposure)
    found = np.empty(codes.shape[1])
    step = max(1, CHUNK // table.shape[1])
    for start in range(0, len(found), step):
        found[start : start + step] = _most_likely(codes[:, start : start + step], kinds, table, light)
    return found


def _most_likely(codes: Array, kinds: Array, table: Array, light: Array) -> Array:
    """Return the most likely `light` [N] of codes [window, N] of these kinds of exposure; equal outcomes count once.

    `table` [len(light), kinds x levels] holds the logarithms of probabilities.
    """
    pixels = np.arange(codes.shape[1])
    bins = np.zeros((len(pixels), kinds.max() + 1, table.shape[1] // (kinds.max() + 1)), np.int32)
    for code, kind in zip(codes, kinds, strict=True):
        bins[pixels, kind, code] += 1
    outcomes, where = np.unique(bins.reshape(len(bins), -1), axis=0, return_inverse=True)
    found = np.empty(len(outcomes))
    step = max(1, CHUNK // len(light))
    for start in range(0, len(outcomes), step):
        found[start : start + step] = few_codes.peak(outcomes[start : start + step] @ table.T, light)
    return found[where.ravel()]


METHODS: dict[str, Estimate] = {"naive": naive, "moment": moment, "likelihood": likelihood}


def table_bytes(shares: Iterable[float], sensor: Sensor, exposure: float) -> int:
    """Return the size [bytes] of the table that `likelihood` takes for these shares; TABLE_BYTES is the most."""
    distinct = tuple(np.unique(list(shares)))
    return 8 * len(levels(distinct, sensor, exposure)) * len(distinct) * sensor.levels


@lru_cache(maxsize=4)
def log_pmf(shares: tuple[float, ...], sensor: Sensor, exposure: float) -> Array:
    """Return the logarithm of the probability of each code of these exposures, [G, shares x levels].

    `ValueError` if it takes more than TABLE_BYTES.
    """
    light = levels(shares, sensor, exposure)
    codes = sensor.levels
    size = table_bytes(shares, sensor, exposure)
    if size > TABLE_BYTES:
        raise ValueError(
            f"likelihood: {len(shares)} different exposures of {sensor.bits} bit need a table of {size / 1e6:.0f} MB, "
            f"and at most {TABLE_BYTES / 1e6:.0f} MB are taken; use the method moment"
        )
    table = np.empty((len(light), len(shares) * codes))
    for n, share in enumerate(shares):
        row = 0
        for part in pieces(light, codes):
            own = table[row : row + len(part), n * codes : (n + 1) * codes]
            np.maximum(sensor.log_pmf(part * share, exposure * share), -1e6, out=own)
            row += len(part)
    return table
