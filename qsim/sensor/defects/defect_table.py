"""Reads the [defects] table of a sensor file, and writes it beside streams. All defects are off by default.

    [defects] of a file --from_toml--> Defects --to_dict--> the table beside a stream

`DefectKeys` declares the keys; each is optional, and a missing one changes no bit. Counting pixels whose light changes
inside the exposure, whose dead time is carried over, or that afterpulse are followed photon by photon
(event_simulation.py) if the largest of these effects exceeds its TOLERANCE; otherwise the closed form draws.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, NotRequired, TypedDict

from qsim import files, limits
from qsim.kinds import Digest, NotNegative
from qsim.records import convert
from qsim.sensor.defects.fixed_pattern import FixedPattern
from qsim.settings import setting

_MAPS = {
    "gain_map": "prnu",
    "dark_map": "dark",
    "dead_map": "dead",
    "offset_map": "offset",
    "read_noise_map": "read_noise",
}
_PATTERN = ("device_seed", "prnu", "dead", "offset", "read_noise")
_DISTURBANCES = ("crosstalk", "afterpulse", "afterpulse_delay")


class MapFile(TypedDict):
    """A measured map as a stream's description states it."""

    file: str
    sha256: NotRequired[Digest]


Map = str | MapFile | None


@dataclass(frozen=True, kw_only=True)
class Disturbances:
    """The keys of [defects] beside those of the fixed pattern."""

    gain_map: Annotated[Map, setting("efficiency over the sensor's [H, W]", example="my_gain.npy")] = None
    dark_map: Annotated[
        Map,
        setting(
            "dark rates [H, W], beside this file; their mean replaces the sensor's", unit="1/s", example="my_dark.npy"
        ),
    ] = None
    dead_map: Annotated[Map, setting("true where a pixel never fires [H, W]", example="my_bad.npy")] = None
    offset_map: Annotated[Map, setting("QIS: codes [H, W]", example="my_offset.npy")] = None
    read_noise_map: Annotated[Map, setting("QIS: read noise [H, W]", unit="e- rms", example="my_rn.npy")] = None
    crosstalk: Annotated[
        NotNegative,
        setting(
            "per neighbour: chance that an avalanche sets off one given of the four; data sheets often give the total, "
            "here 1 - (1 - 0.001)^4 = 0.004 for any of them",
            example=0.001,
        ),
    ] = 0.0
    afterpulse: Annotated[
        NotNegative,
        setting("clocked: chance of a detection caused by one in the plane before", example=0.01),
    ] = 0.0
    afterpulse_delay: Annotated[
        NotNegative, setting("counting: mean delay of the afterpulse of a count", unit="s", example=2e-8)
    ] = 0.0
    carry_dead_time: Annotated[bool, setting("counting: a dead time continues in the next exposure", example=True)] = (
        False
    )


@dataclass(frozen=True, kw_only=True)
class DefectKeys(FixedPattern, Disturbances):
    """The keys of a table [defects]."""


@dataclass(frozen=True)
class Defects:
    """The contents of a table [defects]."""

    pattern: FixedPattern = field(default_factory=FixedPattern)
    maps: Mapping[str, str] = field(default_factory=dict)  # key of the table -> .npy file
    crosstalk: float = 0.0
    afterpulse: float = 0.0
    afterpulse_delay: float = 0.0  # s
    carry_dead_time: bool = False

    @property
    def none(self) -> bool:
        """Whether all defects are off."""
        pattern = replace(self.pattern, device_seed=0)
        return pattern == FixedPattern() and not (
            self.maps or self.crosstalk or self.afterpulse or self.carry_dead_time
        )

    @property
    def read_out(self) -> bool:
        """Whether pixels have their own offset or read noise."""
        own = {"offset_map", "read_noise_map"} & set(self.maps)
        return bool(self.pattern.offset or self.pattern.read_noise or own)

    @property
    def disturbed(self) -> bool:
        """Whether avalanches of neighbours, or of the plane before, set off others."""
        return bool(self.afterpulse or self.crosstalk)

    def to_dict(self) -> dict[str, Any]:
        """Return the table as stored with a stream; measured maps with their checksums."""
        pattern = {key: getattr(self.pattern, key) for key in _PATTERN if getattr(self.pattern, key)}
        if self.pattern.dark is not None:
            pattern["dark"] = asdict(self.pattern.dark)
        maps = {
            key: {"file": path, "sha256": files.sha256(Path(path), limits.ASSET)} for key, path in self.maps.items()
        }
        own = {key: getattr(self, key) for key in (*_DISTURBANCES, "carry_dead_time") if getattr(self, key)}
        return pattern | maps | own


def from_toml(path: str | Path, *, needed: bool = False) -> Defects | None:
    """Return the table [defects] of a sensor file, None if it is missing or all of it is off; `ValueError` if invalid.

    With `needed` the file was named for its defects, and a missing table is an error.
    """
    path = Path(path)
    tables = files.read_toml(path, "file of defects" if needed else "sensor file")
    if needed and "defects" not in tables:
        raise ValueError(f"{path}: has no table [defects]")
    table = tables.get("defects", {})
    if not isinstance(table, dict):
        raise ValueError(f"{path}: [defects] must be a table, got {table!r}")
    files_of = {key: str((path.parent / table[key]).resolve()) for key in _MAPS if isinstance(table.get(key), str)}
    found = from_dict(table | files_of, f"{path}: [defects]")
    return None if found.none else found


def from_dict(table: Mapping[str, Any], where: str = "defects") -> Defects:
    """Return the defects of a table, or of the output of `to_dict`, whose maps must be unchanged.

    `ValueError` for unknown keys and invalid values.
    """
    try:
        keys = convert(table, DefectKeys, where)
    except ValueError as error:
        raise ValueError(str(error).replace("DefectKeys.", "")) from None
    for name, pattern in _MAPS.items():
        if name in table and pattern in table:
            raise ValueError(f"{where}: {pattern} and {name} state the same defect twice; leave one out")
    own = FixedPattern(**{key: getattr(keys, key) for key in (*_PATTERN, "dark")})
    maps = {key: _map_file(table[key], key, where) for key in _MAPS if key in table}
    disturbances = {key: getattr(keys, key) for key in _DISTURBANCES}
    for key in ("crosstalk", "afterpulse"):
        if not disturbances[key] < 1:
            raise ValueError(f"{where}: {key} must be a probability below 1, got {table[key]!r}")
    return Defects(own, maps, **disturbances, carry_dead_time=keys.carry_dead_time)


def _map_file(value: Any, key: str, where: str) -> str:
    """Return the path of a map; errors if it does not exist, or differs from its checksum."""
    path, digest = (value.get("file"), value.get("sha256")) if isinstance(value, Mapping) else (value, None)
    if not isinstance(path, str):
        raise ValueError(f"{where}: {key} must be the name of a .npy file, got {value!r}")
    if not Path(path).is_file():
        raise FileNotFoundError(f"{where}: {key}: {path}: no such file")
    if digest is not None and files.sha256(Path(path), limits.ASSET) != digest:
        raise ValueError(f"{where}: {key}: {path} has changed since the stream was drawn")
    return path
