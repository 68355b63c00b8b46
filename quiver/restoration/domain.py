"""Describes what a network was measured for, and writes remarks where it restores something else.

A measurement has cells of sensor, bits and light, with the PSNR of the network and of the best rival.

    weights file --`quiver domain`--> cells in its metadata;   stream, cells --`remark`--> nothing, or one line

Cells of the same kind of sensor, the same bits and about the same gain are like a stream; the nearest one in log light
is its cell. Light is counted in detected photons: sensors of one kind share their cells at any efficiency. Read noise,
dark counts and defects are not compared. Streams whose light differs from the measured one by more than NEAR have no
cell.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta
from numpy import ndarray as Array

from qsim import records
from qsim.kinds import Bits, Number, Positive, Text
from qsim.tables import markdown_table
from quiver.data.codes import DARKEST, Codes, Sensor, light_of
from quiver.data.illumination import Illumination

FORMAT = "quiver-domain-1"
KEY = "domain"  # of the metadata of a weights file
TIE = 0.05  # dB; differences of single clips scatter so that the mean of three has a standard error of 0.4 to 0.9
NEAR = 1.25  # light and gain within this factor of the measured ones count as equal
UP_TO_A_FACTOR = "restored light is right up to a factor, as the published program learns grey / 255"
SENSOR = "sensor file "  # + its name: the key of its SHA-256
METHODS_ARE = "what the methods do"  # key of their descriptions, which change when results do
CUT = "tiles of a frame"  # key of those that change results

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


# ---- Cells


@dataclass(frozen=True)
class OperatingPoint:
    """The quantities of a stream that decide how informative its codes are."""

    model: Text  # of the sensor: QIS, BinarySPAD, CountingSPAD
    bits: Bits
    light: Positive  # detected photons per pixel and code
    white: Positive  # detected photons at the top code

    def like(self, other: OperatingPoint) -> bool:
        """Return whether kind, bits and gain agree; the gain either in photons, or in units of the light."""
        if (self.model, self.bits) != (other.model, other.bits):
            return False
        relative = (self.white / self.light) / (other.white / other.light)
        return any(abs(math.log(ratio)) <= math.log(NEAR) for ratio in (self.white / other.white, relative))


@dataclass(frozen=True)
class Cell:
    """One measurement: matched PSNR [dB], mean over clips."""

    sensor: Text  # used in the measurement
    ppp: Positive
    place: OperatingPoint
    network: Number
    classical: Text  # the best classical method
    classical_psnr: Number

    @property
    def wins(self) -> bool:
        """Return whether the network is at least as good as the best classical method, but for TIE."""
        return self.network >= self.classical_psnr - TIE

    @property
    def name(self) -> str:
        """Return the text of tables: `quiver-physical, 3 bit, 3.25 PPP`."""
        return f"{self.sensor}, {self.place.bits} bit, {self.ppp:g} PPP"

    @property
    def scores(self) -> str:
        """Return both scores as text."""
        return f"{self.classical} {self.classical_psnr:.1f} dB, network {self.network:.1f} dB"


@dataclass(frozen=True)
class Domain:
    """All cells of one weights file, and the settings of their measurement."""

    cells: tuple[Cell, ...]
    measured: Mapping[str, Any]  # clips, frames, methods, seed, version: the same for all cells

    def nearest(self, place: OperatingPoint) -> Cell | None:
        """Return the cell of a stream; None if nothing near was measured."""
        like = [cell for cell in self.cells if cell.place.like(place)]
        if not like:
            return None
        lights = [cell.place.light for cell in like]
        if not min(lights) / NEAR <= place.light <= max(lights) * NEAR:
            return None
        return min(like, key=lambda cell: abs(math.log(cell.place.light / place.light)))

    @property
    def best_classical(self) -> str:
        """Return the classical method that is best in most cells."""
        names = [cell.classical for cell in self.cells]
        return max(dict.fromkeys(names), key=names.count)

    def to_json(self) -> str:
        """Return the text for the metadata of a weights file."""
        return json.dumps(self.to_dict(), sort_keys=True)

    def to_dict(self) -> dict[str, object]:
        """Return plain values, for JSON."""
        return {"format": FORMAT, "measured": dict(self.measured), "cells": [asdict(cell) for cell in self.cells]}

    @classmethod
    def from_json(cls, text: str) -> Domain:
        """Return the inverse of `to_json`; strict, `ValueError`."""
        try:
            found = json.loads(text)
        except RecursionError:
            raise ValueError("it is nested too deeply") from None
        stored = records.convert(found, _Stored, KEY)
        return cls(stored.cells, stored.measured)


@dataclass(frozen=True)
class _Stored:
    """A domain as the metadata of a weights file hold it."""

    format: Literal["quiver-domain-1"]
    measured: dict[str, Any]
    cells: Annotated[tuple[Cell, ...], Meta(min_length=1, max_length=10_000)]


def place_of(sensor: Sensor, exposure: float, ppp: float) -> OperatingPoint:
    """Return where codes of a sensor lie that receives `ppp` photons per pixel and exposure [s]."""
    efficiency = sensor.efficiency
    return OperatingPoint(type(sensor).__name__, sensor.bits, ppp * efficiency, sensor.white(exposure) * efficiency)


def table(domain: Domain) -> list[str]:
    """Return the cells as a Markdown table, the winner of each in bold."""
    rows = []
    for cell in domain.cells:
        ours = f"{cell.network:.2f}"
        theirs = f"{cell.classical_psnr:.2f}"
        if cell.wins:
            ours = f"**{ours}**"
        else:
            theirs = f"**{theirs}**"
        rows.append((cell.sensor, str(cell.place.bits), f"{cell.ppp:g}", ours, f"{cell.classical} {theirs}"))
    return markdown_table(rows, ("sensor", "bits", "PPP", "network", "best classical method"))


def merged(old: Iterable[Cell], new: Iterable[Cell]) -> tuple[Cell, ...]:
    """Return cells by sensor, bits and light; a new one replaces an old one."""
    found = {(cell.sensor, cell.place.bits, cell.ppp): cell for cell in (*old, *new)}
    return tuple(found[key] for key in sorted(found))


# ---- The weights file


@dataclass(frozen=True)
class Scope:
    """The cells that were measured for a network, else the streams that it was trained on."""

    domain: Domain | None = None
    trained: tuple[Illumination, ...] = ()
    relative: bool = False  # converted weights, see UP_TO_A_FACTOR


def read_scope(path: Path, metadata: Mapping[str, str]) -> Scope:
    """Return the scope in the metadata of a weights file. `ValueError` if the domain in it is damaged."""
    text = metadata.get(KEY)
    try:
        domain = None if text is None else Domain.from_json(text)
    except ValueError as error:
        advice = "measure it again with force=True"
        raise ValueError(f"{path}: its domain is damaged ({error}); {advice}") from None
    return Scope(domain, _trained(metadata.get("settings")), bool(metadata.get("converted_from")))


def _trained(text: str | None) -> tuple[Illumination, ...]:
    """Return sensors, bits and light of the training settings in a weights file; empty if they are missing."""
    try:
        settings = json.loads(text or "{}")
        if settings.get("noise"):
            return tuple(Illumination.from_dict(values) for values in settings["noise"])
        sensors, bits, ppp = (_listed(settings.get(name)) for name in ("sensor", "bits", "ppp"))
        return tuple(
            Illumination.of(str(sensor), light, _whole(depth)) for sensor in sensors for depth in bits for light in ppp
        )
    except (ValueError, TypeError, AttributeError, RecursionError):
        return ()


def _whole(value: Any) -> int | None:
    """Return bits as a whole number, None for those of the sensor."""
    return None if value is None else int(value)


def _listed(value: Any) -> list[Any]:
    if isinstance(value, list):
        return value
    return [] if value is None else [value]


def forget_damaged(weights: Path) -> None:
    """Remove the cells of a weights file whose domain is damaged, so that it can be measured again."""
    from quiver.model.weights import annotate, metadata_of

    try:
        read_scope(weights, metadata_of(weights))
    except ValueError:
        annotate(weights, {KEY: None})


def stored(weights: Path, shared: Mapping[str, object]) -> Domain:
    """Return the cells in a weights file that were measured with these settings, and the settings of all of them."""
    from quiver.model.weights import metadata_of

    domain = read_scope(weights, metadata_of(weights)).domain
    if domain is None or changes(domain.measured, shared):
        return Domain((), shared)
    return Domain(domain.cells, {**domain.measured, **shared})


def changes(measured: Mapping[str, object], shared: Mapping[str, object]) -> list[str]:
    """Return the settings that differ. Sensor files, tiles and descriptions of methods that only one side states are no
    difference.
    """
    one_sided = {key for key in measured.keys() ^ shared.keys() if key.startswith((SENSOR, CUT, METHODS_ARE))}
    return [
        key
        for key in dict.fromkeys((*shared, *measured))
        if key not in one_sided and measured.get(key) != shared.get(key)
    ]


# ---- Remarks


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
    if frames == 1:
        off = 30
    else:
        off = 12 if bits == 1 else 5
    return f"{name} has little to go by in {stream} of {bits} bit: its brightness may be wrong by up to {off} %"


def _dark_share(codes: Codes, ppp: float) -> float:
    """Return the dark counts over the events of the mean light [photons]."""
    return codes.sensor.dark_rate * codes.exposure / (ppp * codes.sensor.efficiency)


def _dark_text(share: float) -> str:
    return f"dark counts are {100 * share:.0f} % of the mean light"


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
    # Medians throughout: things that move are outliers among the squares, and light is what all of them share.
    spread = DEVIATION * np.median(np.abs(ratios - factors[:, None]), axis=1)
    errors = MEDIAN * spread / np.sqrt(bright.shape[1])
    low = int(factors.argmin())
    high = int(factors.argmax())
    return float(max(0.0, factors[high] - factors[low] - CERTAIN * np.hypot(errors[low], errors[high])))
