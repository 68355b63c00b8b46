"""Checks the JSON descriptions of clips, streams, data sets and restored video: one table per kind of file.

    table: {key: kind}      "key" must be there, "key, if any" may be missing or null, "key or null" is null or good
    kind:  a `Kind` (what is expected, and a test), or a table of its own for a JSON object

Keys that no table knows are kept: a writer may add its own. Numbers are finite; NaN never passes.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qsim.checks import SPLITS
from qsim.files import NAME

SMALLEST, LARGEST = 1e-30, 1e30  # of numbers above 0 in SI units: whatever lies outside overflows in the next product


@dataclass(frozen=True)
class Kind:
    """What a value has to be, for a message and as a test."""

    what: str
    good: Callable[[Any], bool]


Table = Mapping[str, "Kind | Table"]


def structure(path: Path, found: Mapping[str, Any], table: Table, cure: str, inside: str = "") -> None:
    """`ValueError` that names file, key and cure if `found` is not as the table says."""
    for entry, kind in table.items():
        optional, nullable = entry.endswith(", if any"), entry.endswith(" or null")
        key = entry.removesuffix(", if any").removesuffix(" or null")
        if key not in found:
            if not optional:
                raise ValueError(f"{path}: key '{inside}{key}' is missing; {cure}")
            continue
        value = found[key]
        if value is None and (optional or nullable):
            continue
        if isinstance(kind, Kind):
            if not kind.good(value):
                raise ValueError(f"{path}: {inside}{key} must be {kind.what}, found {value!r:.60}; {cure}")
        elif isinstance(value, dict):
            structure(path, value, kind, cure, f"{inside}{key}.")
        else:
            raise ValueError(f"{path}: {inside}{key} must be a JSON object, found {value!r:.60}; {cure}")


def is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST


def is_positive(value: Any) -> bool:
    return is_number(value) and value >= SMALLEST


def is_count(value: Any) -> bool:
    return type(value) is int and 0 <= value < 1 << 64


def is_whole(value: Any) -> bool:
    return type(value) is int and 1 <= value < 1 << 40


def list_of(good: Callable[[Any], bool], length: int | None = None) -> Callable[[Any], bool]:
    """A test of lists, of any length or of this one, whose items all pass `good`."""
    return lambda value: isinstance(value, list) and length in (None, len(value)) and all(good(item) for item in value)


def mapping_of(key: str, good: Callable[[Any], bool]) -> Callable[[Any], bool]:
    """A test of JSON objects whose keys all match a pattern and whose values all pass `good`."""
    pattern = re.compile(key)
    return lambda value: (
        isinstance(value, dict) and all(pattern.fullmatch(name) and good(item) for name, item in value.items())
    )


def is_digest(value: Any) -> bool:
    return isinstance(value, str) and re.fullmatch("[0-9a-f]{64}", value) is not None


def is_name(value: Any) -> bool:
    return isinstance(value, str) and NAME.fullmatch(value) is not None


TEXT = Kind("a text", lambda value: isinstance(value, str))
FLAG = Kind("true or false", lambda value: isinstance(value, bool))
NAMED = Kind("a name of letters, digits, '.', '_' and '-'", is_name)
DIGEST = Kind("a SHA-256 of 64 hexadecimal digits", is_digest)
NUMBER = Kind(f"a number within {LARGEST:g}", is_number)
POSITIVE = Kind(f"a number from {SMALLEST:g} to {LARGEST:g}", is_positive)
LIGHT = Kind(f"a number from 0 to {LARGEST:g}", lambda value: is_number(value) and value >= 0)
COUNT = Kind("a whole number from 0", is_count)
WHOLE = Kind("a whole number from 1", is_whole)
SHAPE = Kind("[frames, height, width] of at least 1", list_of(is_whole, 3))
VECTOR = Kind("three numbers", list_of(is_number, 3))
SPLIT = Kind(f"one of {', '.join(SPLITS)}", lambda value: value in SPLITS)
OBJECT: Table = {}

CAMERA: Table = {
    "focal_length": POSITIVE,
    "f_number": POSITIVE,
    "pixel_pitch": POSITIVE,
    "height": WHOLE,
    "width": WHOLE,
    "origin, if any": VECTOR,
    "target, if any": VECTOR,
    "up, if any": VECTOR,
    "transmission, if any": POSITIVE,
    "fill_factor, if any": POSITIVE,
    "wavelength, if any": POSITIVE,
    "focus_distance, if any": POSITIVE,
    "vignetting, if any": FLAG,
    "aperture_blur, if any": FLAG,
}
_FRAME = r"(?:radiance|sharp|truth|saturated)/[0-9]{6,}\.exr"
CLIP: Table = {
    "shape": SHAPE,
    "frame_rate": POSITIVE,
    "exposure": POSITIVE,
    "radiance_unit": TEXT,
    "mean_radiance": LIGHT,
    "checksums": Kind("the SHA-256 of each frame's files", mapping_of(_FRAME, is_digest)),
    "name, if any": NAMED,
    "split, if any": SPLIT,
    "camera, if any": CAMERA,
    "origin, if any": Kind("[y, x] in pixels", list_of(is_count, 2)),
    "mean_photons, if any": LIGHT,
    "shutter, if any": LIGHT,
    "clipped_pixels, if any": COUNT,
    "saturated_pixels, if any": COUNT,
    "saturation, if any": {"white or null": LIGHT, "assumed": FLAG},
    "error_per_frame, if any": Kind("a list of numbers from 0", list_of(lambda v: is_number(v) and v >= 0)),
    "error_at_white_per_frame, if any": Kind("a list of numbers from 0", list_of(lambda v: is_number(v) and v >= 0)),
    "white, if any": LIGHT,
    "psnr_of_truth, if any": NUMBER,
    "psnr_unclamped, if any": NUMBER,
    "fireflies_per_frame, if any": Kind("a list of whole numbers from 0", list_of(is_count)),
    "scene, if any": OBJECT,
    "assets, if any": Kind("a list of texts", list_of(TEXT.good)),
    "job, if any": TEXT,
    "source, if any": OBJECT,
    "orientation, if any": TEXT,
    "render, if any": {
        "findings, if any": Kind(
            "a list of texts by effect, chosen, size",
            list_of(lambda v: mapping_of("effect|chosen|size", TEXT.good)(v) and len(v) == 3),
        )
    },
}
STREAM: Table = {
    "shape": SHAPE,
    "bits": Kind("a whole number from 1 to 16", lambda value: type(value) is int and 1 <= value <= 16),
    "width": WHOLE,
    "sensor": {"model": TEXT},
    "ppp_factor or null": POSITIVE,
    "exposure": POSITIVE,
    "frame_rate": POSITIVE,
    "ppp, if any": LIGHT,
    "ppp_target, if any": POSITIVE,
    "lux_target, if any": POSITIVE,
    "mean_photons_before, if any": LIGHT,
    "equivalent_lux_555nm, if any": LIGHT,
    "seed, if any": COUNT,
    "clip_key, if any": COUNT,
    "planes_per_code, if any": WHOLE,
    "diffraction, if any": FLAG,
    "code_model, if any": TEXT,
    "clip, if any": TEXT,
    "sensor_name, if any": TEXT,
    "sha256, if any": DIGEST,
    "orientation, if any": TEXT,
    "source, if any": OBJECT,
    "defects, if any": OBJECT,
    "drawn_by, if any": TEXT,
    "dead_time_effects, if any": OBJECT,
}
JOB: Table = {"split": SPLIT, "digest": TEXT, "scene, if any": TEXT, "state, if any": TEXT, "record, if any": DIGEST}
DATASET: Table = {"name": TEXT, "recipe": {"recipe, if any": OBJECT}, "jobs": OBJECT}
RECORD: Table = {
    "clip": DIGEST,
    "digest": TEXT,
    "split": SPLIT,
    "streams": Kind("the SHA-256 of each stream's description", mapping_of(NAME.pattern, is_digest)),
}
RESTORED: Table = {
    "method": TEXT,
    "description, if any": TEXT,
    "seconds_per_frame": LIGHT,
    "unit, if any": TEXT,
    "white, if any": POSITIVE,
    "shape, if any": SHAPE,
    "frame_rate, if any": POSITIVE,
    "exposure, if any": POSITIVE,
    "sensor, if any": {"model": TEXT},
    "source, if any": TEXT,
    "sha256, if any": DIGEST,
}
