"""Orders files by the numbers in their names: 2 before 10, and decimals by their value.

RAW_0.25 comes before RAW_0.5, and 1726830927.5 before 1726830928.125; a decimal comma and a power of ten with a sign
(0,25, 1e-3) count as well. Numbers are compared exactly.

A minus between a text and a number may be a sign or a hyphen: z-1 beside z1 has signs, z-1 beside z-2 has hyphens.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

_COMMA = re.compile(r"(?<=[0-9]),(?=[0-9])")
_MINUS = "\N{MINUS SIGN}"  # stands for a hyphen that is a sign
_DATE = re.compile(r"(?<![0-9a-zA-Z])[0-9]+-[0-9]+-[0-9]+$")  # or a time: its last number counts nothing alone
# A power has a sign and at most two digits, and no hexadecimal digit follows: 410e-41d4 is a part of an identifier.
_TOKEN = re.compile("(" + _MINUS + r"?[0-9]+(?:\.[0-9]+)*(?:[eE][+-][0-9]{1,2}(?![0-9a-fA-F]))?)")


def _signed(names: list[str]) -> list[str]:
    """Return the names with a minus sign for the hyphens that are one: other names have none at that place."""
    parts = [_split(name) for name in names]
    for i in range(0, min((len(each) for each in parts), default=0) - 1, 2):
        texts = {each[i] for each in parts}
        longest = max(texts, key=len)
        if longest.endswith("-") and texts == {longest, longest[:-1]}:
            for each in parts:
                if each[i] == longest:
                    each[i] = longest[:-1] + _MINUS
    return ["".join(each) for each in parts]


def natural(name: str) -> tuple[list[Any], str]:
    """Return a key that sorts names by their numbers, and equal numbers by the text."""
    return _parts(name), name


def _split(name: str) -> list[str]:
    """Return texts and numbers of a name in turn, with a point in every decimal."""
    return _TOKEN.split(_COMMA.sub(".", name))


def _number(part: str) -> Fraction:
    return Fraction(part.replace(_MINUS, "-"))


def _parts(name: str) -> list[Any]:
    """Return texts and numbers of a name in turn; it begins and ends with a text.

    A point or a comma between digits makes a decimal; with two of them (10.11.2026) each number stands alone.
    """
    found: list[Any] = []
    for i, part in enumerate(_split(name)):
        if not i % 2:
            found.append(part)
        elif part.count(".") <= 1:
            found.append(_number(part))
        else:
            first, *others = part.split(".")
            found.append(_number(first))
            for other in others:
                found += [".", Fraction(other)]
    return found


def _last(names: list[str]) -> list[Fraction] | None:
    """Return the last number of each name, None if one has none.

    After a number that is equal in all names, whole numbers without a gap count (shot1.9, shot1.10), else it is a
    decimal.
    """
    tokens = [("", *_split(name)[1::2])[-1] for name in names]
    if not all(tokens):
        return None
    heads, tails = ([part.rpartition(".")[i] for part in tokens] for i in (0, 2))
    if heads and heads[0] and len(set(heads)) == 1:
        whole = [Fraction(tail) for tail in tails]
        if _without_gap(whole):
            return whole
    return [next(part for part in reversed(_parts(name)) if isinstance(part, Fraction)) for name in names]


def _without_gap(values: list[Fraction]) -> bool:
    """Return whether values are different whole numbers that follow one another."""
    whole = all(value.denominator == 1 for value in values)
    return whole and len(set(values)) == len(values) and max(values) - min(values) < len(values)


def _counter(names: list[str]) -> list[Fraction] | None:
    """Return the last number of each name if it alone orders them, else None.

    Each file has its own, and either none is left out or the names differ in more than numbers (3fa_1, 0c7_2).
    """
    if all(_DATE.search(name) for name in names):
        return None
    last = _last(names)
    if not last or len(set(last)) < len(last):
        return None
    texts = {tuple(part for part in _parts(name) if isinstance(part, str)) for name in names}
    return last if _without_gap(last) or len(texts) > 1 else None


def places(paths: list[Path]) -> list[Fraction] | None:
    """Return the number of each file that counts frames or states a time; None if no single number does.

    It is the counter of `numbered`, or the only number in which the names differ.
    """
    names = _signed([path.stem for path in paths])
    if (counted := _counter(names)) is not None:
        return counted
    parts = [_parts(name) for name in names]
    if len({len(each) for each in parts}) != 1:
        return None
    differing = [i for i in range(len(parts[0])) if len({each[i] for each in parts}) > 1]
    if len(differing) != 1 or not differing[0] % 2:
        return None
    return [each[differing[0]] for each in parts]


def numbered(paths: Iterable[Path], below: Path | None = None) -> list[Path]:
    """Return files in the order of the numbers in their names; a text sort puts 10 before 2.

    All numbers count, as in 0.999 before 1.000, but the last one alone where it is a counter. Files of different
    folders are sorted by folder; with `below` by all numbers of their paths in that folder. Hidden files are left out:
    some systems put one beside each file.
    """
    shown = [path for path in paths if not path.name.startswith(".")]
    if below is not None:
        inside = _signed([str(path.relative_to(below).with_suffix("")) for path in shown])
        return [path for _, path in sorted(zip(map(natural, inside), shown, strict=True))]
    names = _signed([path.stem for path in shown])
    counted = _counter(names)
    keys = [_parts(name) for name in names] if counted is None else [[value] for value in counted]
    ordered = sorted(
        zip(shown, keys, strict=True), key=lambda pair: (_parts(str(pair[0].parent)), pair[1], pair[0].name)
    )
    return [path for path, _ in ordered]
