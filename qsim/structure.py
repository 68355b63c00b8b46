"""Checks tables of TOML and JSON files by one function, and makes dataclasses of them.

    table:  {key: check}; "key" must be there, "key, if any" may be missing or null, "key or null" may be null
    check:  a function that returns the value or raises `ValueError("expected ..., got ...")`, or a nested table

Every message names the place (a file, and in recipes the line), the key, what is expected and what was found. Numbers
are finite; NaN never passes.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from qsim import checks
from qsim.checks import SPLITS, shown, suggest
from qsim.files import NAME

# of numbers above 0 in SI units: products of larger ones overflow
SMALLEST = 1e-30
LARGEST = 1e30

Check = Callable[[Any], Any]
Table = Mapping[str, "Check | Table"]
Where = str | Callable[[str | None], str]  # the place of a table, or of a key in it (None: of the table)
Made = TypeVar("Made")


def structure(
    found: Any, table: Table, where: Where, *, of: str = "", closed: bool = True, cure: str = "", inside: str = ""
) -> dict[str, Any]:
    """Return the values as their checks return them; `ValueError` if `found` is not as the table says.

    `of` names the table in messages and `cure` says what to do. A closed table refuses keys that it does not list.
    """
    place = where if callable(where) else lambda _: where
    title = of and f" in {of}"
    advice = cure and f"; {cure}"
    if not isinstance(found, Mapping):
        raise ValueError(
            f"{place(None)}: {inside and f'{inside[:-1]}: '}expected a table of values, got {shown(found)}{advice}"
        )
    known = {entry.removesuffix(", if any").removesuffix(" or null"): entry for entry in table}
    for key in found if closed else ():
        if key not in known:
            meant = f"{suggest(key, known)}; known are {', '.join(known)}"
            raise ValueError(f"{place(key)}: unknown key '{inside}{key:.60}'{title}{meant}")
    values = dict(found)
    for key, entry in known.items():
        if key not in found:
            if not entry.endswith(", if any"):
                raise ValueError(f"{place(None)}: key '{inside}{key}' is missing{title}{advice}")
            continue
        if found[key] is None and entry != key:
            continue
        check = table[entry]
        if isinstance(check, Mapping):
            below = f"{inside}{key}."
            values[key] = structure(found[key], check, where, of=of, closed=closed, cure=cure, inside=below)
            continue
        try:
            values[key] = check(found[key])
        except (ValueError, OverflowError) as error:
            raise ValueError(f"{place(key)}: {inside}{key}: {error}{advice}") from None
    return values


def description(path: Path, found: Mapping[str, Any], table: Table, cure: str) -> None:
    """`ValueError` if the JSON description in a file is not as the table says; further keys are a writer's own."""
    structure(found, table, str(path), closed=False, cure=cure)


def make(kind: type[Made], found: Any, where: str) -> Made:
    """Return the dataclass that the table `found` describes; `ValueError` with the place, also from its own checks."""
    values = structure(found, table_of(kind), where, of=kind.__name__)
    try:
        return kind(**values)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def table_of(kind: Any) -> Table:
    """Return the table of a dataclass: its fields by their types; a field that has a default may be missing."""
    hints = get_type_hints(kind)
    given = {field.name: field.default is MISSING and field.default_factory is MISSING for field in fields(kind)}
    return {name if needed else f"{name}, if any": _check_of(hints[name]) for name, needed in given.items()}


def _check_of(hint: Any) -> Check | Table:
    """Return the check of a field's type: bool, int, float, tuple[int, ...], a dataclass, or one of them or None."""
    if isinstance(hint, UnionType):
        (hint,) = set(get_args(hint)) - {NoneType}
    if is_dataclass(hint):
        return table_of(hint)
    if get_origin(hint) is tuple:
        item = _CHECKS[get_args(hint)[0]]
        several = expected("a list", lambda value: isinstance(value, list | tuple))
        return lambda value: tuple(item(one) for one in several(value))
    return _CHECKS[hint]


_CHECKS: dict[Any, Check] = {bool: checks.flag, int: checks.integer, float: checks.real}


def expected(what: str, good: Callable[[Any], bool]) -> Check:
    """Return a check that passes values for which `good` is true, and otherwise reports that `what` is expected."""

    def check(value: Any) -> Any:
        if not good(value):
            raise ValueError(f"expected {what}, got {shown(value)}")
        return value

    return check


def is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST


def is_positive(value: Any) -> bool:
    return is_number(value) and value >= SMALLEST


def is_light(value: Any) -> bool:
    return is_number(value) and value >= 0


def is_count(value: Any) -> bool:
    return type(value) is int and 0 <= value < 1 << 64


def is_whole(value: Any) -> bool:
    return type(value) is int and 1 <= value < 1 << 40


def list_of(good: Callable[[Any], bool], length: int | None = None) -> Callable[[Any], bool]:
    """Return a test of lists whose items all pass `good`, of this length if it is given."""
    return lambda value: isinstance(value, list) and length in (None, len(value)) and all(good(item) for item in value)


def mapping_of(key: str, good: Callable[[Any], bool]) -> Callable[[Any], bool]:
    """Return a test of JSON objects whose keys match a pattern and whose values pass `good`."""
    pattern = re.compile(key)
    return lambda value: (
        isinstance(value, dict) and all(pattern.fullmatch(name) and good(item) for name, item in value.items())
    )


def is_text(value: Any) -> bool:
    return isinstance(value, str)


def is_digest(value: Any) -> bool:
    return isinstance(value, str) and re.fullmatch("[0-9a-f]{64}", value) is not None


def is_name(value: Any) -> bool:
    return isinstance(value, str) and NAME.fullmatch(value) is not None


def is_bands(value: Any) -> bool:
    return list_of(is_positive, 3)(value)


def is_video_shape(value: Any) -> bool:
    return list_of(is_whole)(value) and (len(value) == 3 or (len(value) == 4 and value[1] == 3))


TEXT = expected("a text", is_text)
FLAG = expected("true or false", lambda value: isinstance(value, bool))
NAMED = expected("a name of letters, digits, '.', '_' and '-'", is_name)
DIGEST = expected("a SHA-256 of 64 hexadecimal digits", is_digest)
NUMBER = expected(f"a number within {LARGEST:g}", is_number)
POSITIVE = expected(f"a number from {SMALLEST:g} to {LARGEST:g}", is_positive)
LIGHT = expected(f"a number from 0 to {LARGEST:g}", is_light)
LIGHTS = expected("a list of numbers from 0", list_of(is_light))
COUNT = expected("a whole number from 0", is_count)
WHOLE = expected("a whole number from 1", is_whole)
SHAPE = expected("[frames, height, width] of at least 1", list_of(is_whole, 3))
VECTOR = expected("three numbers", list_of(is_number, 3))
PLACE = expected("[y, x] in pixels", list_of(is_count, 2))
SPLIT = expected(f"one of {', '.join(SPLITS)}", lambda value: value in SPLITS)
OBJECT: Table = {}

LENS: Table = {
    "k1": NUMBER,
    "k2": NUMBER,
    "falloff": expected("a list of numbers", list_of(is_number)),
    "shift": expected("two numbers", list_of(is_number, 2)),
    **{f"{key}, if any": NUMBER for key in ("k3", "k4", "p1", "p2", "aspect")},
}
_several = expected("a list", lambda value: isinstance(value, list))
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
    "lens, if any": LENS,
    "zoom, if any": {
        "times": expected("a list of numbers", list_of(is_number)),
        "distances": expected("a list of numbers above 0", list_of(is_positive)),
        "lenses": lambda value: [structure(each, LENS, "a lens", closed=False) for each in _several(value)],
    },
}


def _flickers(value: Any) -> bool:
    """Return whether a JSON value describes the flicker of a light, with its strength in each frame."""
    if not (isinstance(value, dict) and is_text(value.get("kind")) and is_number(value.get("frequency"))):
        return False
    strengths = value.get("strength")
    return list_of(is_light)(strengths) and bool(strengths)


TIMES: Table = {
    "unit": TEXT,
    "source": TEXT,
    "values": expected("a list of numbers", list_of(is_number)),
}
_FRAME = r"(?:radiance|sharp|truth|saturated)/[0-9]{6,}\.exr"
CLIP: Table = {
    "shape": SHAPE,
    "frame_rate": POSITIVE,
    "exposure": POSITIVE,
    "radiance_unit": TEXT,
    "mean_radiance": LIGHT,
    "checksums": expected("the SHA-256 of each frame's files", mapping_of(_FRAME, is_digest)),
    "name, if any": NAMED,
    "split, if any": SPLIT,
    "camera, if any": CAMERA,
    "bands, if any": expected("three wavelengths in m", is_bands),
    "origin, if any": PLACE,
    "mean_photons, if any": LIGHT,
    "shutter, if any": LIGHT,
    "flicker, if any": expected(
        "the kind and the strengths from 0 of each light", mapping_of(r"[^\n]{1,200}", _flickers)
    ),
    "poses, if any": expected("a matrix of 4 x 4 numbers per frame", list_of(list_of(list_of(is_number, 4), 4))),
    "clipped_pixels, if any": COUNT,
    "saturated_pixels, if any": COUNT,
    "saturation, if any": {"white or null": LIGHT, "assumed": FLAG},
    "error_per_frame, if any": LIGHTS,
    "error_at_white_per_frame, if any": LIGHTS,
    "white, if any": LIGHT,
    "psnr_of_truth, if any": NUMBER,
    "psnr_unclamped, if any": NUMBER,
    "fireflies_per_frame, if any": expected("a list of whole numbers from 0", list_of(is_count)),
    "scene, if any": OBJECT,
    "assets, if any": expected("a list of texts", list_of(is_text)),
    "job, if any": TEXT,
    "source, if any": OBJECT,
    "orientation, if any": TEXT,
    "times, if any": TIMES,
    "render, if any": {
        "findings, if any": expected(
            "a list of texts by effect, chosen, size",
            list_of(lambda v: mapping_of("effect|chosen|size", is_text)(v) and len(v) == 3),
        )
    },
}
JOB: Table = {"split": SPLIT, "digest": TEXT, "scene, if any": TEXT, "state, if any": TEXT, "record, if any": DIGEST}
DATASET: Table = {"name": TEXT, "recipe": {"recipe, if any": OBJECT}, "jobs": OBJECT}
RECORD: Table = {
    "clip": DIGEST,
    "digest": TEXT,
    "split": SPLIT,
    "streams": expected("the SHA-256 of each stream's description", mapping_of(NAME.pattern, is_digest)),
}
RESTORED: Table = {
    "method": TEXT,
    "description, if any": TEXT,
    "seconds_per_frame": LIGHT,
    "unit, if any": TEXT,
    "white, if any": POSITIVE,
    "shape, if any": expected("[frames, height, width] or [frames, 3, height, width]", is_video_shape),
    "colour, if any": OBJECT,
    "frame_rate, if any": POSITIVE,
    "exposure, if any": POSITIVE,
    "sensor, if any": {"model": TEXT},
    "source, if any": TEXT,
    "sha256, if any": DIGEST,
}
