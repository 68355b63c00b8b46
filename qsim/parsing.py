"""Parses TOML and JSON texts; errors name file and line, and deep nesting and huge numbers are refused.

These are checks that msgspec leaves out: it takes whole numbers of any size, ends at Python's own limit of nesting, and
names no line. Records are made of the values by `records.convert`.
"""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any

from qsim.limits import BENEATH, WHOLE

_TOO_LARGE = "a whole number of more than 64 bits"
_TOO_DEEP = f"nested more than {BENEATH} levels deep"


def parse_toml(path: Path, text: str) -> dict[str, Any]:
    """Return the tables of a TOML text; `ValueError` as `FILE:LINE: ...` for bad TOML, deep nesting, huge numbers."""
    if re.search(
        rf"(?<![\w\"'.-])(?:[\w\"'-]+[ \t]*\.[ \t]*){{{BENEATH}}}", text
    ):  # the parser takes quadratic time for these
        raise ValueError(f"{path}:{_line_of_depth(text)}: not valid TOML: {_TOO_DEEP}")
    try:
        value = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        found = re.search(r"at line (\d+)", str(error))
        line = found[1] if found else len(text.splitlines())  # else the parser reports "at end of document"
        raise ValueError(f"{path}:{line}: not valid TOML: {error}") from None
    except RecursionError:
        raise ValueError(f"{path}:{_line_of_depth(text)}: not valid TOML: {_TOO_DEEP}") from None
    except ValueError:  # of `int` for thousands of digits
        raise ValueError(f"{path}:{_line_of_number(text)}: not valid TOML: {_TOO_LARGE}") from None
    if problem := _too_much(value, text, infinite=True):  # which TOML can spell; each key's check refuses it
        raise ValueError(f"{path}:{problem[0]}: not valid TOML: {problem[1]}")
    return value


def parse_json(path: Path, text: str) -> dict[str, Any]:
    """Return the object in a JSON text; `ValueError` with the name of the file if it is damaged or no object.

    NaN, infinity, whole numbers beyond 64 bits and deep nesting are refused: this program never writes them.
    """
    try:
        value = json.loads(text, parse_constant=_no_constant)
        problem = _too_much(value, text)
    except RecursionError:
        problem = (_line_of_depth(text), _TOO_DEEP)
        value = None
    except (json.JSONDecodeError, _NotFinite) as error:
        raise ValueError(f"{path}: not readable as JSON ({error}); the file is damaged, make it again") from None
    except ValueError:  # of `int` for thousands of digits
        problem = (_line_of_number(text), _TOO_LARGE)
        value = None
    if problem:
        raise ValueError(
            f"{path}: not readable as JSON ({problem[1]} in line {problem[0]}); the file is damaged, make it again"
        )
    if not isinstance(value, dict):
        raise ValueError(f"{path}: expected a JSON object, found a {type(value).__name__}")
    return value


def require_readable(value: Any, where: str) -> None:
    """Raise `ValueError` for a value that `parse_json` would refuse once it is stored."""
    if problem := _too_much([value], ""):
        raise ValueError(f"{where} would hold {problem[1]}, which no reader accepts")


class _NotFinite(ValueError):
    """NaN or infinity in JSON."""


def _no_constant(name: str) -> float:
    raise _NotFinite(f"{name} where a number is needed")


def _too_much(value: Any, text: str, infinite: bool = False) -> tuple[int, str] | None:
    """Return (line, problem) of the first value that is nested too deeply or too large; None if there is none."""
    waiting: list[tuple[Any, int]] = [([value], 0)]
    while waiting:
        item, depth = waiting.pop()
        for inner in item.values() if isinstance(item, dict) else item:
            if isinstance(inner, dict | list):
                if depth == BENEATH:
                    return _line_of_depth(text), _TOO_DEEP
                waiting.append((inner, depth + 1))
            elif isinstance(inner, int) and abs(inner) >= WHOLE:
                return _line_of_number(text), _TOO_LARGE
            elif isinstance(inner, float) and not infinite and abs(inner) == float("inf"):
                return 1, "a number of more than 1e308"
    return None


def _line_of_depth(text: str) -> int:
    """Return the first line that nests too deeply, by brackets or by dots; 1 if none is found."""
    depth = 0
    for n, line in enumerate(text.splitlines(), 1):
        bare = re.sub(r'"(?:\\.|[^"\\])*"', "", line)
        if len(re.findall(r"[\w\"'-]\s*\.", line)) >= BENEATH:
            return n
        for sign in bare:
            depth += (sign in "[{") - (sign in "]}")
            if depth > BENEATH:
                return n
    return 1


def _line_of_number(text: str) -> int:
    """Return the line of the first whole number of more than 18 digits; 1 if none is found."""
    digits = r"(?<![\w\"'.])(?:0[xob][0-9A-Fa-f_]{16,}|[0-9][0-9_]{18,})(?![\w\"'.])"
    return next((n for n, line in enumerate(text.splitlines(), 1) if re.search(digits, line)), 1)
