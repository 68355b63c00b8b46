"""Writes remarks on networks that restore a stream outside of what they were measured for."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy import ndarray as Array

from quiver.data.codes import DARKEST, Codes, light_of
from quiver.data.illumination import Illumination
from quiver.restoration.domain import NEAR, UP_TO_A_FACTOR, OperatingPoint, Scope, place_of
from quiver.restoration.interface import RestoreOptions, Restorer
from quiver.restoration.mosaics import by_colour

DARK = 0.1  # dark counts over the events of the mean light, above which a stream is unlike all cells
CHANGE = 0.08  # of the light within eleven frames, above which a stream is unlike all cells: they reach 0.05
# of the shortest stream that is like them, of more bits and of one: restorer_limits.md
FRAMES = 4
BINARY_FRAMES = 11
LOOKED_AT = 11  # frames in the middle of the stream, in which a change of light is looked for
SIDE = 16  # px of a square, less where the picture is small
FEWEST = 9  # squares, below which the answer is 0
CERTAIN = 6.0  # standard errors that a change exceeds: motion makes neighbouring squares alike
MEDIAN = 1.2533  # standard error of a median over that of a mean, of normal numbers
DEVIATION = 1.4826  # standard deviation over the median distance from the median, of normal numbers


def remark(name: str, scope: Scope, codes: Codes) -> str | None:
    """Return one line where a network is outside of what it was measured for; None inside."""
    ppp = light_of(codes)
    if ppp <= DARKEST * codes.white:
        return f"{name} was never measured in such darkness: the codes tell no light"
    place = place_of(codes.sensor, codes.exposure, ppp)
    stream = f"{codes.sensor_name or place.model}, {place.bits} bit, {ppp:.3g} PPP"
    if scope.domain is None:
        return _unmeasured(name, scope.trained, codes, place, stream)
    cell = scope.domain.nearest(place)
    if cell is None:
        best = scope.domain.best_classical
        text = f"{name} was never measured near {stream}; where it was, {best} is mostly the best classical method"
        dark = _dark_share(codes, ppp)
        return text if dark <= DARK else f"{text}; {_dark_text(dark)}, and dark places may become too bright"
    if not cell.wins:
        return f"{name} is worse than {cell.classical} on {stream}: {cell.scores} at {cell.name}"
    return _unlike_cells(name, codes, ppp)


def _unlike_cells(name: str, codes: Codes, ppp: float) -> str | None:
    """Return the remark on a stream whose dark counts, changes of light or frames are unlike those of all cells."""
    dark = _dark_share(codes, ppp)
    if dark > DARK:
        return (
            f"{name} was never measured where {_dark_text(dark)}, and makes dark places too bright there; "
            "compare with qbp-bm3d"
        )
    change = light_change(codes)
    if change > CHANGE:
        return (
            f"{name} was never trained on light that changes, here by at least {100 * change:.0f} % within eleven "
            "frames; compare with qbp-bm3d"
        )
    return _too_short(name, codes.shape[0], codes.sensor.bits)


def _too_short(name: str, frames: int, bits: int) -> str | None:
    """Return the remark on a stream of few frames: by how much a flat field was wrong, at 0.3 to 3.25 PPP."""
    if frames >= (BINARY_FRAMES if bits == 1 else FRAMES):
        return None
    stream = "one frame" if frames == 1 else f"{frames} frames"
    off = 30 if frames == 1 else 12 if bits == 1 else 5
    return f"{name} was never trained on {stream} of {bits} bit, and its brightness may be wrong by up to {off} %"


def _dark_share(codes: Codes, ppp: float) -> float:
    """Return the dark counts over the events of the mean light [photons]."""
    return codes.sensor.dark_rate * codes.exposure / (ppp * codes.sensor.efficiency)


def _dark_text(share: float) -> str:
    return f"dark counts are {100 * share:.0f} % of the mean light"


def remarks(methods: Iterable[Restorer], codes: Codes) -> list[str]:
    """Return the remarks on all networks among the methods."""
    return [text for method in methods for text in _remarks(method, codes)]


def _remarks(method: Restorer, codes: Codes) -> list[str]:
    """Return the different remarks on a method, of a mosaic on the light of each colour, which is restored alone.

    None for a classical one, and where there is nothing to say.
    """
    if method.scope is None:
        return []
    said = [remark(method.name, method.scope, part) or _run_unlike(method) for part in by_colour(codes)]
    if method.scope.relative:
        said = [f"{text or f'{method.name} was converted'}; {UP_TO_A_FACTOR}" for text in said]
    return list(dict.fromkeys(text for text in said if text is not None))


def _run_unlike(method: Restorer) -> str | None:
    """Return the remark on a network that runs otherwise than when it was measured: in mode or precision."""
    if method.scope is None or method.scope.domain is None:
        return None
    usual = {"mode": RestoreOptions.mode, "precision": RestoreOptions.precision}
    now = [str(method.identity.get(key) or value) for key, value in usual.items()]
    then = [str(method.scope.domain.measured.get(key) or value) for key, value in usual.items()]
    if now == then:
        return None
    return (
        f"{method.name} was measured in {' and '.join(then)}, and runs in {' and '.join(now)}: nothing tells how well"
    )


def measured_at(method: Restorer, codes: Codes) -> str | None:
    """Return the measurement that is nearest to a stream, as a line for --verbose; None where there is none.

    Of a mosaic it is that of every colour.
    """
    if method.scope is None or method.scope.domain is None:
        return None
    places = [place_of(part.sensor, part.exposure, light_of(part)) for part in by_colour(codes)]
    cells = [cell for place in places if (cell := method.scope.domain.nearest(place)) is not None]
    told = dict.fromkeys(f"{cell.name}: {cell.scores}" for cell in cells)
    return f"{method.name} was measured at {'; '.join(told)}" if told else None


def refuse_outside(methods: Sequence[Restorer], found: Sequence[str], option: str, *, named: bool = True) -> None:
    """Raise `ValueError` for `strict`, the name of whose option is given: with the first remark, or without a network.

    Methods that were not `named` are the choice of `auto`: a classical one is no mistake.
    """
    if named and not any(method.learned for method in methods):
        names = ", ".join(method.name for method in methods)
        raise ValueError(f"{option}: acts on networks, and {names} is classical; leave it out")
    if found:
        raise ValueError(f"{found[0]}; leave out {option} to run it nevertheless")


def _unmeasured(name: str, trained: Sequence[Illumination], codes: Codes, place: OperatingPoint, stream: str) -> str:
    """Return the remark on weights without cells: what they were trained on, and whether the stream is like that."""
    start = f"{name} was never measured against the classical methods"
    if not trained:
        return f"{start}, and its file does not state what it was trained on; this stream is {stream}"
    words = ", ".join(dict.fromkeys(light.sensor for light in trained))
    depths = ", ".join(str(bits) for bits in sorted({light.bits for light in trained if light.bits is not None}))
    levels = ", ".join(f"{ppp:g}" for ppp in sorted({light.ppp for light in trained if light.ppp is not None}))
    if any(_same(light, codes, place) for light in trained):
        return f"{start}; it was trained on such streams ({stream})"
    return f"{start}; it was trained on {words}, {depths or 'own'} bit, {levels or 'own'} PPP, this stream is {stream}"


def _same(light: Illumination, codes: Codes, place: OperatingPoint) -> bool:
    """Return whether a stream lies where training was."""
    if light.ppp is None:
        return False
    try:
        seen = place_of(light.device(codes.exposure), codes.exposure, light.ppp)
    except (ValueError, OSError):  # the sensor's file is missing
        return False
    return seen.like(place) and abs(math.log(seen.light / place.light)) <= math.log(NEAR)


# ---- Light that changes


def light_change(codes: Codes) -> float:
    """Return the least change of light, largest minus smallest over the mean, that noise and motion do not explain.

    Light that changes brightens all squares of a picture alike. Things that move brighten some and darken others, so
    that the median over squares stays; the mean does not: it changes by up to 23 % in scenes of constant light.
    0 for constant light, and where the codes do not tell: few squares, darkness, saturation, different exposures.
    """
    length, height, width = codes.shape
    side = max(4, min(SIDE, height // 6, width // 6))
    rows = height // side
    columns = width // side
    if rows * columns < 2 * FEWEST or length < 2 or codes.shares is not None:
        return 0.0
    first = max(0, (length - LOOKED_AT) // 2)
    frames = codes.read(first, min(length, first + LOOKED_AT))[:, : rows * side, : columns * side]
    means = frames.reshape(len(frames), rows, side, columns, side).mean(axis=(2, 4)).reshape(len(frames), -1)
    try:
        light = codes.sensor.response(codes.exposure).invert(means, side * side)
    except ValueError:
        return 0.0
    return _change(np.asarray(light, float))


def _change(light: Array) -> float:
    """Return the change of the light [T, squares], from the brighter half of the squares."""
    mean = light.mean(axis=0)
    bright = light[:, (mean >= np.median(mean)) & (mean > 0)]
    if bright.shape[1] < FEWEST:
        return 0.0
    ratios = bright / bright.mean(axis=0)
    factors = np.median(ratios, axis=1)
    spread = DEVIATION * np.median(np.abs(ratios - factors[:, None]), axis=1)
    errors = MEDIAN * spread / np.sqrt(bright.shape[1])
    low = int(factors.argmin())
    high = int(factors.argmax())
    return float(max(0.0, factors[high] - factors[low] - CERTAIN * np.hypot(errors[low], errors[high])))
