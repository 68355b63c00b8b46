"""Describes colour filter arrays: a mask of colours over the pixels, and the efficiency of each in every band.

    photons of R, G, B [..., 3, H, W]  --mosaic-->  light of a sensor without filters [..., H, W]  --its law-->  codes

A pixel of colour c collects sum_b efficiency[c][b] photons_b + dark electrons. That is what a sensor without filters
collects of sum_b (efficiency[c][b] / efficiency) photons_b: its exact law, its keys and its engines draw every mosaic.

`ColourKeys` declares the keys of a table [colour]. Without `efficiency` a filter passes all light of its band, and W of
all bands, to the efficiency of the sensor.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy import ndarray as Array

from qsim import files
from qsim.checks import suggest
from qsim.host import own_numbers
from qsim.records import convert
from qsim.settings import setting

BANDS = "RGB"
MASKS = {
    "rggb": ("RG", "GB"),
    "quad": ("RRGG", "RRGG", "GGBB", "GGBB"),
    "rgbw": ("RG", "WB"),
    "red": ("R",),  # one filter over all pixels: three such streams are a camera with a beam splitter
    "green": ("G",),
    "blue": ("B",),
}
# Electrons or avalanches per photon of R, G and B. Without bounds, which `ColourFilter` checks: msgspec 0.22 reads a
# bound of a number beside a tuple of three from another place in memory.
Efficiency = tuple[float, float, float]


_MASK = f'one of {", ".join(MASKS)}, or rows of a tile of letters: ["RG", "GB"]'


@dataclass(frozen=True, kw_only=True)
class ColourKeys:
    """The keys of a table [colour]."""

    mask: Annotated[
        str | tuple[str, ...],
        setting(_MASK, example="rggb"),
    ]
    efficiency: Annotated[
        dict[str, float | Efficiency] | None,
        setting(
            "of the filters of a colour: for photons of its band, or for those of R, G and B",
            unset="that of the sensor",
            example={"R": 0.45, "G": 0.60, "B": 0.50, "W": [0.70, 0.75, 0.60]},
        ),
    ] = None


@own_numbers
@dataclass(frozen=True)
class ColourFilter:
    """A colour filter array. The tile repeats over the frame, from its pixel (0, 0) on."""

    mask: tuple[str, ...]  # rows of a tile, one letter per pixel
    efficiency: Mapping[str, Efficiency] | None = None  # of each letter; None: that of the sensor in its band

    def __post_init__(self) -> None:
        lengths = sorted({len(row) for row in self.mask})
        if len(lengths) != 1 or lengths[0] < 1:
            found = ", ".join(map(repr, self.mask)) or "no row"
            raise ValueError(f"mask: does not tile, rows need equally many letters, as in 'RG', 'GB'; got {found}")
        if self.efficiency is None:
            unknown = sorted(set("".join(self.mask)) - set("RGBW"))
            if unknown:
                raise ValueError(f"efficiency: colour {unknown[0]} of the mask has none; give efficiency.{unknown[0]}")
            return
        for colour in dict.fromkeys("".join(self.mask)):
            if colour not in self.efficiency:
                raise ValueError(f"efficiency: colour {colour} of the mask has none; give efficiency.{colour}")
        for colour, values in self.efficiency.items():
            if colour not in "".join(self.mask):
                raise ValueError(f"efficiency.{colour}: the mask has no such colour; leave it out")
            if not (len(values) == 3 and min(values) >= 0 and 0 < max(values) <= 1):
                raise ValueError(f"efficiency.{colour}: three numbers from 0 to 1, one above 0, got {list(values)}")

    @property
    def tile(self) -> tuple[int, int]:
        """Rows and columns of the tile."""
        return len(self.mask), len(self.mask[0])

    def shifted(self, y: int, x: int) -> ColourFilter:
        """Return the array as frames see it whose first pixel lies at row y, column x of the full frame."""
        rows, columns = self.tile
        turned = [self.mask[(y + i) % rows] for i in range(rows)]
        return replace(self, mask=tuple("".join(row[(x + j) % columns] for j in range(columns)) for row in turned))

    def weights(self, efficiency: float) -> Array:
        """Return what a photon of each band counts in the light of a sensor of this efficiency: [3, rows, columns]."""
        found = {
            colour: np.array(self.efficiency_of(colour, efficiency)) / efficiency for colour in set("".join(self.mask))
        }
        return np.moveaxis(np.array([[found[colour] for colour in row] for row in self.mask]), -1, 0)

    def efficiency_of(self, colour: str, efficiency: float) -> Efficiency:
        """Return the efficiency of a colour for photons of R, G and B, on a sensor of this efficiency."""
        if self.efficiency is not None:
            return self.efficiency[colour]
        red, green, blue = (efficiency * (colour in (band, "W")) for band in BANDS)
        return red, green, blue

    def mean_efficiency(self, efficiency: float) -> float:
        """Return the mean over the tile of the electrons per photon of every band."""
        return float(efficiency * self.weights(efficiency).sum(axis=0).mean())

    def over(self, efficiency: float, height: int, width: int, origin: tuple[int, int] = (0, 0)) -> Array:
        """Return `weights` of every pixel, [3, height, width]; `origin` (y, x) places a crop in the frame."""
        rows, columns = self.tile
        y = (np.arange(height) + origin[0]) % rows
        x = (np.arange(width) + origin[1]) % columns
        return self.weights(efficiency)[:, y[:, None], x]

    def mosaic(self, photons: Array, efficiency: float, origin: tuple[int, int] = (0, 0)) -> Array:
        """Return the light [..., H, W] for a sensor of this efficiency, of photons of R, G and B [..., 3, H, W]."""
        height, width = photons.shape[-2:]
        return np.asarray((photons * self.over(efficiency, height, width, origin)).sum(axis=-3))

    def words(self, efficiency: float) -> str:
        """Return mask and efficiencies as text: `mask RG GB, efficiency R 0.45, G 0.6, B 0.5`."""
        each = []
        for colour in dict.fromkeys("".join(self.mask)):
            values = self.efficiency_of(colour, efficiency)
            own = [value for value in values if value]
            each.append(f"{colour} {own[0]:g}" if len(own) == 1 else f"{colour} {'/'.join(f'{v:g}' for v in values)}")
        rows = self.mask if len(self.mask) <= 8 else (f"of {self.tile[0]} x {self.tile[1]} pixels",)
        return f"mask {' '.join(rows)}, efficiency {', '.join(each)}"

    def to_dict(self) -> dict[str, Any]:
        """Return the table as stored with a stream; `from_dict` reads it."""
        efficiency = None if self.efficiency is None else {key: list(value) for key, value in self.efficiency.items()}
        return {"mask": list(self.mask)} | ({} if efficiency is None else {"efficiency": efficiency})


def load(name: str | Path) -> ColourFilter:
    """Return the colour filter array of a name in `MASKS`, or of a .toml file with a table [colour]."""
    if str(name) in MASKS:
        return ColourFilter(MASKS[str(name)])
    if Path(name).suffix != ".toml":
        known = ", ".join(MASKS)
        raise ValueError(
            f"unknown colour filter array {str(name)!r}{suggest(str(name), MASKS)}; {known}, or a .toml file"
        )
    found = from_toml(name)
    if found is None:
        raise ValueError(f"{name}: has no table [colour]; give mask and efficiency there")
    return found


def from_toml(path: str | Path) -> ColourFilter | None:
    """Return the table [colour] of a TOML file, None without one; `ValueError` if it is invalid."""
    table = files.read_toml(Path(path), "sensor file").get("colour")
    return None if table is None else from_dict(table, f"{path}: [colour]")


def from_dict(table: Any, where: str = "colour") -> ColourFilter:
    """Return the array of a table, or of the output of `to_dict`; strict, `ValueError`."""
    if not isinstance(table, Mapping) or "mask" not in table:
        raise ValueError(f'{where}: a table with mask = "rggb" is needed, got {table!r:.200}')
    keys = convert(table, ColourKeys, where)
    if isinstance(keys.mask, str) and keys.mask not in MASKS:
        raise ValueError(f"{where}: mask is one of {', '.join(MASKS)} or rows of letters, got {keys.mask!r:.200}")
    mask = MASKS[keys.mask] if isinstance(keys.mask, str) else keys.mask
    given = keys.efficiency
    efficiency = None if given is None else {name: _per_band(name, value, where) for name, value in given.items()}
    try:
        return ColourFilter(mask, efficiency)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def _per_band(colour: str, value: float | Efficiency, where: str) -> Efficiency:
    """Return the efficiency of a colour for each band, from a number (its own band) or three."""
    if isinstance(value, tuple):
        return value
    if colour not in BANDS:
        raise ValueError(f"{where}: efficiency.{colour}: three numbers are needed, for photons of R, G and B")
    red, green, blue = (float(value) * (band == colour) for band in BANDS)
    return red, green, blue
