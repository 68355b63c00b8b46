"""Describes what a network was measured for: cells of sensor, bits and light, its PSNR and the best rival's.

    weights file --`quiver domain`--> cells in its metadata;   stream, cells --`remark`--> nothing, or one line

Cells of the same kind of sensor, the same bits and about the same gain are like a stream; the nearest one in log light
is its cell. Light is counted in detected photons: sensors of one kind share their cells at any efficiency. Read noise,
dark counts and defects are not compared. Streams whose light differs from the measured one by more than NEAR have no
cell.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from qsim.tables import markdown_table
from quiver.data.codes import Sensor
from quiver.data.illumination import Illumination
from quiver.data.noise import Noise

FORMAT = "quiver-domain-1"
KEY = "domain"  # of the metadata of a weights file
TIE = 0.05  # dB; differences of single clips scatter so that the mean of three has a standard error of 0.4 to 0.9
NEAR = 1.25  # light and gain within this factor of the measured ones count as equal
MAX_CELLS = 10_000
UP_TO_A_FACTOR = "restored light is right up to a factor, as the published program learns grey / 255"


@dataclass(frozen=True)
class OperatingPoint:
    """The quantities of a stream that decide how informative its codes are."""

    model: str  # of the sensor: QIS, BinarySPAD, CountingSPAD
    bits: int
    light: float  # detected photons per pixel and code
    white: float  # detected photons at the top code

    def like(self, other: OperatingPoint) -> bool:
        """Return whether kind, bits and gain agree; the gain either in photons, or in units of the light."""
        if (self.model, self.bits) != (other.model, other.bits):
            return False
        relative = (self.white / self.light) / (other.white / other.light)
        return any(abs(math.log(ratio)) <= math.log(NEAR) for ratio in (self.white / other.white, relative))


@dataclass(frozen=True)
class Cell:
    """One measurement: matched PSNR [dB], mean over clips."""

    sensor: str  # used in the measurement
    ppp: float
    place: OperatingPoint
    network: float
    classical: str  # the best classical method
    classical_psnr: float

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

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        return {"format": FORMAT, "measured": dict(self.measured), "cells": [asdict(cell) for cell in self.cells]}

    @classmethod
    def from_json(cls, text: str) -> Domain:
        """Return the inverse of `to_json`; strict, `ValueError`."""
        try:
            found = json.loads(text)
            if not isinstance(found, dict) or found.get("format") != FORMAT or not isinstance(found["measured"], dict):
                raise ValueError(f"its format is not {FORMAT!r}")
            if not isinstance(found["cells"], list) or not 0 < len(found["cells"]) <= MAX_CELLS:
                raise ValueError(f"it holds 1 to {MAX_CELLS} cells")
            return cls(tuple(_cell(values) for values in found["cells"]), found["measured"])
        except (KeyError, TypeError, AttributeError, RecursionError, OverflowError) as error:
            raise ValueError(f"{type(error).__name__}: {' '.join(str(error).split())}"[:200]) from None


def _cell(values: Mapping[str, Any]) -> Cell:
    cell = Cell(**{**values, "place": OperatingPoint(**values["place"])})
    kinds: dict[str, tuple[type, ...]] = {
        "str": (str,),
        "int": (int,),
        "float": (int, float),
        "OperatingPoint": (OperatingPoint,),
    }
    for part in (cell, cell.place):
        for field in fields(part):
            value = getattr(part, field.name)
            good = isinstance(value, kinds[str(field.type)]) and not isinstance(value, bool)
            if not good or (isinstance(value, int | float) and not math.isfinite(value)):
                raise ValueError(f"{field.name} = {repr(value)[:60]} is not valid")
    if not (cell.place.bits >= 1 and min(cell.ppp, cell.place.light, cell.place.white) > 0):
        raise ValueError(f"a cell of {cell.place.bits} bit at {cell.ppp!r} photons is not valid")
    return cell


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
        advice = "measure it again with `quiver domain --force`"
        raise ValueError(f"{path}: its domain is damaged ({error}); {advice}") from None
    return Scope(domain, _trained(metadata.get("settings")), bool(metadata.get("converted_from")))


def _trained(text: str | None) -> tuple[Illumination, ...]:
    """Return sensors, bits and light of the training settings in a weights file; empty if they are missing."""
    try:
        settings = json.loads(text or "{}")
        if settings.get("noise"):
            return tuple(Noise.from_dict(values) for values in settings["noise"])
        sensors, bits, ppp = (_listed(settings.get(name)) for name in ("sensor", "bits", "ppp"))
        return tuple(
            Illumination(str(sensor), None if light is None else float(light), None if depth is None else int(depth))
            for sensor in sensors
            for depth in bits
            for light in ppp
        )
    except (ValueError, TypeError, AttributeError, RecursionError):
        return ()


def _listed(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [] if value is None else [value]


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
        ours, theirs = (f"**{ours}**", theirs) if cell.wins else (ours, f"**{theirs}**")
        rows.append((cell.sensor, str(cell.place.bits), f"{cell.ppp:g}", ours, f"{cell.classical} {theirs}"))
    return markdown_table(rows, ("sensor", "bits", "PPP", "network", "best classical method"))


def merged(old: Iterable[Cell], new: Iterable[Cell]) -> tuple[Cell, ...]:
    """Return cells by sensor, bits and light; a new one replaces an old one."""
    found = {(cell.sensor, cell.place.bits, cell.ppp): cell for cell in (*old, *new)}
    return tuple(found[key] for key in sorted(found))
