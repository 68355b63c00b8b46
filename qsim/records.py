"""Makes records of plain values: what TOML and JSON hold becomes frozen dataclasses whose fields state their bounds.

    {"bits": 3, "rows": {...}}  --convert-->  a record      `ValueError`: FILE: rows.order: expected one of ..., got ...

A field's type is all that is said about it: `Annotated[int, Meta(ge=1, le=16)]` is checked, described in messages and
in the manual (`words_of`), and written into the JSON Schema. Further rules are the record's own `__post_init__`.
"""

from __future__ import annotations

import atexit
import ctypes
import dataclasses
import functools
import gc
import re
import types
from collections.abc import Callable, Mapping
from typing import (
    Annotated,
    Any,
    Literal,
    NotRequired,
    Required,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
)

import msgspec
import numpy as np

from qsim import kinds
from qsim.checks import shown, suggest

Made = TypeVar("Made")
_ANY = "[...]"  # what msgspec says of a key of a dictionary
_PLACE = re.compile(r" - at (?P<key>`key` in )?`\$(?P<path>[^`]*)`$")
_LAYOUTS = ("DataclassInfo", "NamedTupleInfo", "TypedDictInfo")  # types of msgspec, which exports none of them
_PART = re.compile(r"\.?(?P<name>[^.\[\]]+)|\[(?P<number>\d+|\.\.\.)\]")


def keep_layouts() -> int:
    """Keep what msgspec knows of types until the process is gone; return how many layouts are kept.

    At the end of a process the collector clears them in any order, and in some orders msgspec 0.22 ends with SIGSEGV in
    its TypeNode_Free, after all work is done: every fourth command that made a data set.
    """
    found = [each for each in gc.get_objects() if type(each).__name__ in _LAYOUTS]
    for layout in found:
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(layout))
    return len(found)


atexit.register(keep_layouts)


def convert(found: Any, kind: type[Made], where: str, *, cure: str = "") -> Made:
    """Return the record (or other type) of plain values; `ValueError` with the place, what is expected and what stands
    there. Keys that the record lacks are refused with the one that was meant; a `TypedDict`, of another program's
    values, leaves them out. `cure` says what to do.
    """
    advice = f"; {cure}" if cure else ""
    _refuse_unknown(found, kind, where, "", advice)
    try:
        return msgspec.convert(found, kind)
    except msgspec.ValidationError as error:
        raise ValueError(f"{where}: {_told(str(error), found, kind)}{advice}") from None
    except RecursionError:
        raise ValueError(f"{where}: is nested too deeply{advice}") from None


def refuse_unknown(found: Any, kind: Any, where: str) -> None:
    """Raise `ValueError` for the first key that a record of this type does not have, with the one that was meant."""
    _refuse_unknown(found, kind, where, "", "")


def plain(record: Any, *, complete: bool = False) -> Any:
    """Return a record as the values that JSON and TOML hold; fields at their default are left out unless `complete`."""
    if dataclasses.is_dataclass(record) and not isinstance(record, type):
        given = {}
        for field in dataclasses.fields(record):
            value = getattr(record, field.name)
            if complete or not _is_default(field, value):
                given[field.name] = plain(value, complete=complete)
        return given
    if isinstance(record, Mapping):
        return {key: plain(value, complete=complete) for key, value in record.items()}
    if isinstance(record, list | tuple):
        return [plain(item, complete=complete) for item in record]
    return _of_python(record)


def settle(record: Any) -> None:
    """Bring the fields of a frozen dataclass into the form of their types; for its `__post_init__`.

    Whole numbers become floats, lists tuples, and scalars of NumPy those of Python, as they would be after a file was
    written and read. `ValueError` with field, what is expected and what was given if a value does not fit.
    """
    for name, hint in hints_of(type(record)).items():
        value = getattr(record, name)
        try:
            settled = _settled(value, hint)
        except msgspec.ValidationError:
            raise ValueError(f"{name}: expected {words_of(hint)}, got {shown(value)}") from None
        object.__setattr__(record, name, settled)


def hints_of(kind: Any) -> dict[str, Any]:
    """Return the types of a record's fields, with their bounds, in order."""
    return dict(_hints_of(kind))


@functools.lru_cache(maxsize=512)
def _hints_of(kind: Any) -> dict[str, Any]:
    """Return the same; evaluating annotations took a quarter of the time of a training window."""
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(kind)}


def members_of(hint: Any) -> tuple[Any, ...]:
    """Return the alternatives of a type, None apart: those of `A | B | None` are A and B."""
    bare = bare_type(hint)
    if get_origin(bare) in (Union, types.UnionType):
        return tuple(inner for member in get_args(bare) for inner in members_of(member))
    return () if bare is type(None) else (hint,)


def bare_type(hint: Any) -> Any:
    """Return a type without its annotations."""
    while get_origin(hint) in (Annotated, Required, NotRequired):
        hint = get_args(hint)[0]
    return hint


def words_of(hint: Any) -> str:
    """Return what a type expects, as in `a whole number from 1 to 16`."""
    found: list[str] = []
    for member in members_of(hint):
        item = _item_hint(member, 0)
        if item is not Any and found and _words(item) == found[-1]:
            found[-1] += ", or a list of them,"
        elif (words := _words(member)) not in found:
            found.append(words)
    return " or ".join(found).removesuffix(",")


def _words(hint: Any) -> str:
    """Return what one alternative of a type expects."""
    bare = bare_type(hint)
    bounds = bounds_of(hint)
    if "words" in bounds:
        return str(bounds["words"])
    origin = get_origin(bare)
    if origin is Literal:
        return "one of " + ", ".join(str(value).lower() if value is True else str(value) for value in get_args(bare))
    if origin in (tuple, list):
        return _words_of_list(bare, bounds)
    if bare is bool:
        return "true or false"
    if bare is str:
        return "a text"
    if bare in (int, float):
        return f"{'a whole number' if bare is int else 'a number'}{_span(bounds)}"
    if dataclasses.is_dataclass(bare) or is_typeddict(bare) or origin is dict or bare is dict:
        return "a table of values"
    if origin is Callable:
        return "a function"
    return f"a {getattr(bare, '__name__', bare)}"


def _words_of_list(bare: Any, bounds: Mapping[str, Any]) -> str:
    """Return what a list or tuple expects: how many of what."""
    items = [item for item in get_args(bare) if item is not Ellipsis]
    if not items:
        return "a list"
    if get_origin(bare) is tuple and Ellipsis not in get_args(bare):
        return f"a list of {len(items)}: {words_of(items[0])}"
    least = bounds.get("min_length")
    most = bounds.get("max_length")
    if most is not None:
        return f"a list of {least or 0} to {most}: {words_of(items[0])}"
    return f"a list of {f'at least {least}' if least else 'any length'}: {words_of(items[0])}"


def _span(bounds: Mapping[str, Any]) -> str:
    """Return bounds of a number in words, as in ` from 1 to 16`; those that only keep products finite go unnamed."""
    low = bounds.get("ge")
    high = bounds.get("le")
    if "gt" in bounds or low == kinds.SMALLEST:
        first = f" above {bounds.get('gt', 0):g}"
    else:
        first = "" if low is None or low == -kinds.LARGEST else f" from {_figure(low)}"
    if "lt" in bounds:
        return f"{first}{' and' if first else ''} below {_figure(bounds['lt'])}"
    if high is None or high >= kinds.LARGEST or (isinstance(high, int) and high >= kinds.UNLIMITED):
        return first
    return f"{first} to {_figure(high)}" if first else f" of at most {_figure(high)}"


def _figure(number: float) -> str:
    """Return a number as people write it."""
    return f"{number:g}" if isinstance(number, float) else str(number)


def bounds_of(hint: Any) -> dict[str, Any]:
    """Return what the annotations of a type state: ge, gt, le, lt, min_length, max_length, pattern, and its words."""
    found: dict[str, Any] = {}
    while get_origin(hint) in (Annotated, Required, NotRequired):
        inner, *notes = get_args(hint)
        for meta in notes:
            if isinstance(meta, msgspec.Meta):
                for name in ("ge", "gt", "le", "lt", "min_length", "max_length", "pattern"):
                    value = getattr(meta, name)
                    if value is not None:
                        found.setdefault(name, value)
                if meta.extra and "words" in meta.extra:
                    found.setdefault("words", meta.extra["words"])
        hint = inner
    return found


def _refuse_unknown(found: Any, hint: Any, where: str, path: str, advice: str) -> None:
    """Raise `ValueError` for the first key that a record of this type does not have."""
    for member in members_of(hint):
        bare = bare_type(member)
        if isinstance(found, Mapping) and dataclasses.is_dataclass(bare):
            known = hints_of(bare)
            for key, value in found.items():
                if key not in known:
                    meant = f"{suggest(str(key), known)}; known are {', '.join(known)}"
                    raise ValueError(f"{where}: unknown key '{path}{key!s:.60}'{meant}{advice}")
                _refuse_unknown(value, known[key], where, f"{path}{key}.", advice)
        elif isinstance(found, Mapping) and get_origin(bare) is dict:
            for key, value in found.items():
                _refuse_unknown(value, get_args(bare)[1], where, f"{path}{key}.", advice)
        elif isinstance(found, list | tuple) and get_origin(bare) in (list, tuple):
            kinds = [item for item in get_args(bare) if item is not Ellipsis]
            for n, value in enumerate(found):
                _refuse_unknown(value, kinds[min(n, len(kinds) - 1)], where, f"{path.rstrip('.')}[{n}].", advice)


def _told(problem: str, found: Any, kind: Any) -> str:
    """Return a message of msgspec in our words: path, what is expected, what stands there."""
    match = _PLACE.search(problem)
    path = match["path"] if match else ""
    text = problem[: match.start()] if match else problem
    missing = re.fullmatch(r"Object missing required field `(.*)`", text)
    if missing:
        return f"key '{path.lstrip('.') + '.' if path else ''}{missing[1]}' is missing"
    name = path.lstrip(".")
    before = f"{name}: " if name else ""
    if match and match["key"]:
        return f"{before}{_misfit_key(*_at(path, kind, found))}"
    if not re.match(r"(Expected|Invalid|Number|Integer|Object)\b", text):
        return f"{before}{text}"  # of the record's own rules
    path = _with_keys(path, kind, found)
    hint, value = _at(path, kind, found)
    return f"{path.lstrip('.')}{': ' if path else ''}expected {words_of(hint)}, got {shown(value)}"


def _with_keys(path: str, kind: Any, found: Any) -> str:
    """Return a path of msgspec, which does not say which value of a dictionary does not fit, with its key."""
    while _ANY in path:
        before, _, after = path.partition(_ANY)
        hint, values = _at(before, kind, found)
        key = _first_misfit(hint, values)
        if key is None:
            return path
        path = f"{before}.{key}{after}"
    return path


def _at(path: str, hint: Any, value: Any) -> tuple[Any, Any]:
    """Return type and value at a path such as `.scenes[0].seeds[1]`."""
    for part in _PART.finditer(path):
        number = part["number"]
        if number is not None:
            if number == "...":  # no key is at fault
                return hint, value
            value = value[int(number)]
            hint = _item_hint(hint, int(number))
            continue
        value = value.get(part["name"]) if isinstance(value, Mapping) else getattr(value, part["name"])
        hint = _field_hint(hint, part["name"])
    return hint, value


def _first_misfit(hint: Any, values: Mapping[str, Any]) -> str | None:
    """Return the key of the first value of a dictionary that does not fit; None if all do, and for a key with a dot."""
    kind = _value_hint(hint)
    for key, value in values.items():
        try:
            msgspec.convert(value, kind)
        except msgspec.ValidationError:
            return key if re.fullmatch(r"\w+", key) else None
    return None


def _value_hint(hint: Any) -> Any:
    """Return the type of the values of a dictionary; None for another type."""
    dicts = [bare_type(member) for member in members_of(hint) if get_origin(bare_type(member)) is dict]
    return get_args(dicts[0])[1] if dicts else None


def _field_hint(hint: Any, name: str) -> Any:
    """Return the type of a field of a record or a typed dictionary."""
    for member in members_of(hint):
        bare = bare_type(member)
        if dataclasses.is_dataclass(bare):
            return hints_of(bare)[name]
        if is_typeddict(bare):
            return get_type_hints(bare, include_extras=True)[name]
    return _value_hint(hint) or Any


def _misfit_key(hint: Any, values: Mapping[Any, Any]) -> str:
    """Return what is expected of the keys of a dictionary, and the first that does not fit."""
    (kind,) = (get_args(bare_type(member))[0] for member in members_of(hint) if get_origin(bare_type(member)) is dict)
    for key in values:
        try:
            msgspec.convert(key, kind)
        except msgspec.ValidationError:
            return f"expected {words_of(kind)} as key, got {shown(key)}"
    return f"expected {words_of(kind)} as key"


def _item_hint(hint: Any, number: int) -> Any:
    """Return the type of an item of a list."""
    for member in members_of(hint):
        kinds = [item for item in get_args(bare_type(member)) if item is not Ellipsis]
        if get_origin(bare_type(member)) in (list, tuple) and kinds:
            return kinds[min(number, len(kinds) - 1)]
    return Any


def _settled(value: Any, hint: Any) -> Any:
    """Return a value in the form of its type; `ValidationError` if it fits none of the alternatives.

    Objects that no file holds are instances of one of the classes that the type names.
    """
    if isinstance(value, tuple) and value and all(dataclasses.is_dataclass(item) for item in value):
        return value  # records have settled themselves
    classes = []
    alternatives = []
    for member in members_of(hint):
        bare = bare_type(member)
        if get_origin(bare) is Callable and callable(value):
            return value
        if isinstance(bare, type) and get_origin(bare) is None and not _is_plain(bare):
            classes.append(bare)
        else:
            alternatives.append(member)
    if (value is None and _may_be_none(hint)) or isinstance(value, tuple(classes)):
        return value
    value = _of_python(value)
    problem: Exception = msgspec.ValidationError("no alternative")
    for member in alternatives:
        try:
            return msgspec.convert(value, member)
        except msgspec.ValidationError as error:
            problem = error
    raise problem


def _of_python(value: Any) -> Any:
    """Return a value with scalars and arrays of NumPy as numbers and lists of Python."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, list | tuple):
        return [_of_python(item) for item in value]
    return value


def _may_be_none(hint: Any) -> bool:
    """Return whether None is one of the alternatives of a type."""
    bare = bare_type(hint)
    if get_origin(bare) in (Union, types.UnionType):
        return any(_may_be_none(member) for member in get_args(bare))
    return bare is type(None)


def is_of_files(member: Any) -> bool:
    """Return whether one alternative of a type is a plain value, as TOML and JSON hold it."""
    bare = bare_type(member)
    return get_origin(bare) is not None or _is_plain(bare)


def _is_plain(kind: type) -> bool:
    """Return whether TOML and JSON have values of a class."""
    return kind in (bool, int, float, str, list, tuple, dict)


def _is_default(field: dataclasses.Field[Any], value: Any) -> bool:
    """Return whether a field holds its default."""
    if field.default_factory is not dataclasses.MISSING:
        return bool(value == field.default_factory())
    return field.default is not dataclasses.MISSING and type(value) is type(field.default) and value == field.default
