"""Names the axes of arrays and TIFF files, and chooses the frames [T, Y, X] among them.

Letters: T time, Z depth, C channel, Y rows (or H), X columns (or W), S the colours of a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy import ndarray as Array

from qsim.formats.recording import Hints

TIME = "TIQZ"  # axes that may be the frames, the first that exists: I and Q are those without a meaning in TIFF
PICKED = {"C": "channel", "Z": "slice"}  # axes of which a hint chooses one index


@dataclass(frozen=True)
class Reading:
    """How an array becomes frames."""

    index: tuple[Any, ...]  # of the array: a number, or all of an axis
    order: tuple[int, ...]  # of the axes that stay: T (if there is one), Y, X (S)
    timed: bool  # one of them is the frames
    colour: bool  # the last is colours
    said: str

    def view(self, array: Any) -> Any:
        """Return the array as [T, Y, X] or [T, Y, X, S], without a copy."""
        found = array[self.index].transpose(self.order)
        return found if self.timed else found[None]

    def shape(self, sizes: tuple[int, ...]) -> tuple[int, ...]:
        """Return the shape of `view` of an array of these sizes."""
        left = [size for size, index in zip(sizes, self.index, strict=True) if isinstance(index, slice)]
        found = tuple(left[i] for i in self.order)
        return found if self.timed else (1, *found)

    def block(self, start: int, stop: int) -> tuple[Any, ...]:
        """Return the index of frames start ... stop - 1 in the stored order of axes, for files that read by parts."""
        kept = [i for i, index in enumerate(self.index) if isinstance(index, slice)]
        found = list(self.index)
        if self.timed:
            found[kept[self.order[0]]] = slice(start, stop)
        return tuple(found)

    def turned(self, block: Array) -> Array:
        """Return a block that was read by `block` as [t, Y, X] or [t, Y, X, S]."""
        found: Array = block.transpose(self.order)
        return found if self.timed else found[None]


def named(path: Path, sizes: tuple[int, ...], hints: Hints, stated: str | None = None) -> Reading:
    """Return how axes of these sizes are read: by `axes`, else as the file has `stated` them, else [T, Y, X].

    `ValueError` names the axes of which one index must be chosen.
    """
    given = hints.axes
    unasked = "TYX" if stated is None and len(sizes) == 3 else _distinct(stated)
    axes = unasked if given is None else _checked(path, given, sizes)
    if axes is None:
        raise ValueError(
            f"{path}: expected frames [T, H, W], found an array of shape {list(sizes)}; name its axes, as in axes="
            f"{'YX' if len(sizes) == 2 else 'TCYX'}"
        )
    missing = [letter for letter in "YX" if letter not in axes]
    if missing:
        raise ValueError(f"{path}: axes {axes} lack {' and '.join(missing)}; rename them with axes=")
    sizes_of = dict(zip(axes, sizes, strict=True))
    picks = _picks(path, axes, sizes_of, hints)
    spare = [letter for letter in axes if letter not in "YXS" and letter not in picks and sizes_of[letter] > 1]
    times = [letter for letter in TIME if letter in spare]
    other = [letter for letter in spare if letter not in TIME]
    if len(times) > 1 or other:
        _refuse(path, axes, sizes_of, spare)
    time = times[0] if times else next((letter for letter in TIME if letter in axes and letter not in picks), None)
    index = tuple(slice(None) if letter in (time, "Y", "X", "S") else picks.get(letter, 0) for letter in axes)
    kept = [letter for letter in axes if letter in (time, "Y", "X", "S")]
    wanted = [letter for letter in (time, "Y", "X", "S") if letter in kept]
    order = tuple(kept.index(str(letter)) for letter in wanted)
    sizes_said = ", ".join(f"{'T' if letter == time else letter}={sizes_of[str(letter)]}" for letter in wanted)
    chosen = "".join(f"; {PICKED[letter]} {n} of {sizes_of[letter]}" for letter, n in picks.items())
    as_time = f"; {time} is time" if time not in (None, "T") else ""
    return Reading(index, order, time is not None, "S" in kept, f"read as {sizes_said} of axes {axes}{as_time}{chosen}")


def _distinct(stated: str | None) -> str | None:
    """Return stated names with a letter of its own for each axis: tifffile calls all unknown ones Q."""
    if stated is None:
        return None
    found = ""
    for letter in stated:
        free = [other for other in "QRABDEFGHJKLMNOPUVW" if other not in stated + found]
        found += letter if letter not in found else free[0]
    return found


def _checked(path: Path, given: str, sizes: tuple[int, ...]) -> str:
    """Return the user's names of axes in capitals; H and W are Y and X."""
    axes = given.upper().replace(",", "").replace(" ", "")
    if "Y" not in axes and "X" not in axes:
        axes = axes.replace("H", "Y").replace("W", "X")
    if not axes.isalpha() or len(set(axes)) < len(axes):
        raise ValueError(f"{path}: axes={given!r:.40}: a different letter for each axis is expected, as in TCYX")
    if len(axes) != len(sizes):
        raise ValueError(f"{path}: axes={given}: names {len(axes)} axes, and the array has {list(sizes)}")
    return axes


def _picks(path: Path, axes: str, sizes: dict[str, int], hints: Hints) -> dict[str, int]:
    """Return the chosen index of axes C and Z."""
    found = {}
    for letter, name in PICKED.items():
        if letter not in axes:
            hints.refuse(path, f"axes {axes}", name)
        index = getattr(hints, name)
        if index is None:
            continue
        if index >= sizes[letter]:
            raise ValueError(f"{path}: {name}={index}: axis {letter} has {sizes[letter]}, from 0")
        found[letter] = index
    return found


def _refuse(path: Path, axes: str, sizes: dict[str, int], spare: list[str]) -> None:
    said = ", ".join(f"{letter}={sizes[letter]}" for letter in axes)
    cures = [f"{PICKED[letter]}=0 (to {sizes[letter] - 1})" for letter in spare if letter in PICKED]
    renamed = f"name the axis of the frames T, as in axes={axes.replace(spare[0], 'T')}"
    if cures:
        cure = f"choose with {' and '.join(cures)}" + ("" if "T" in axes else f", or {renamed}")
    else:
        cure = renamed if "T" not in axes else "name them with axes=, as in TCYX"
    raise ValueError(f"{path}: axes {said}: frames have one axis beside rows and columns; {cure}")
