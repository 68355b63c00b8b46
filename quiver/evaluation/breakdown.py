"""Breaks a mean score down: the error of every speed of motion, and crops of one place by every method.

restored, truth, |flow| [H, W] -> squared errors and pixels per bin of motion -> PSNR per bin, pooled over clips
middle frame, place of most motion -> crop per method -> one sheet of crops
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy import ndarray as Array

from qsim.figures import new_figure, write_figure
from qsim.files import load_array, replacing, sync_folder
from quiver.data.codes import Codes, CodeTruth
from quiver.evaluation import metrics

EDGES = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, math.inf)  # px per code
CROP = 96  # px, at most
SCENES_SHOWN = 6  # rows of a sheet


def bin_names() -> list[str]:
    """Return `0-0.5`, ..., `8 and more`, in px per code."""
    return [f"{low:g} and more" if math.isinf(high) else f"{low:g}-{high:g}" for low, high in pairwise(EDGES)]


def speeds(truth: CodeTruth, codes: range) -> Array | None:
    """Return motion [T, H, W] in px per code from the clip's own flow, NaN where it is not known; None without flow."""
    if not truth.has_truth:
        return None
    return np.stack([np.hypot(*truth.flow(t)) for t in codes])


def by_motion(matched: Array, target: Array, speed: Array) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Return pixels and summed squared error (clamped, in units of the peak) of every bin of EDGES; all arrays [T, H,
    W]. The error of videos in colour, [T, 3, H, W], is the mean over their bands.
    """
    squares = (np.clip(matched, 0, 1) - np.clip(target, 0, 1)) ** 2
    squares = squares.mean(axis=1) if squares.ndim == 4 else squares
    known = np.isfinite(speed)
    bins = np.digitize(speed[known], EDGES[1:-1])
    count = np.bincount(bins, minlength=len(EDGES) - 1)
    total = np.bincount(bins, squares[known], minlength=len(EDGES) - 1)
    return tuple(int(n) for n in count), tuple(float(s) for s in total)


def pooled(counts: Sequence[Sequence[int]], squares: Sequence[Sequence[float]]) -> list[float]:
    """Return the PSNR [dB] of every bin over several clips; NaN for a bin without pixels or with its error above the
    peak.
    """
    if not counts:
        return [math.nan] * (len(EDGES) - 1)
    pixels = np.sum(counts, axis=0)
    total = np.sum(squares, axis=0)
    return [metrics.decibel(s / n) if s > 0 else math.nan for n, s in zip(pixels, total, strict=True)]


# Crops


def place(truth: CodeTruth, t: int) -> tuple[slice, slice]:
    """Return the square of at most CROP px in code t with most motion, in steps of 8 px; the middle without flow."""
    height, width = truth.clip.shape[1:]
    side = min(CROP, height, width)
    found = speeds(truth, range(t, t + 1))
    if found is None:
        y = (height - side) // 2
        x = (width - side) // 2
    else:
        moving = np.minimum(np.nan_to_num(found[0]), EDGES[-2])  # limits the influence of very fast pixels
        corners = [(y, x) for y in range(0, height - side + 1, 8) for x in range(0, width - side + 1, 8)]
        y, x = max(corners, key=lambda corner: moving[corner[0] : corner[0] + side, corner[1] : corner[1] + side].sum())
    return slice(y, y + side), slice(x, x + side)


def crop_file(out: Path, light: str, clip: str, name: str) -> Path:
    """Return the file of the crop of one clip of this name: truth, codes, or that of a method with its settings."""
    words = (re.sub(r"[^A-Za-z0-9.]+", "-", word) for word in (light, clip, name))
    return out / "crops" / ("_".join(words) + ".npy")


def save_crop(path: Path, picture: Array) -> None:
    """Store a float16 picture, [h, w] or [3, h, w], in units of the peak, limited to 2: a sheet shows white there."""
    if not path.parent.is_dir():
        path.parent.mkdir(exist_ok=True)
        sync_folder(path.parent.parent)  # the row that says that the crops are there is synced after it
    with replacing(path) as file:
        np.save(file, np.minimum(picture, 2).astype(np.float16))


def keep_crops(
    out: Path, light: str, truth: CodeTruth, codes: Codes, frames: range, stacks: Mapping[str, Array]
) -> None:
    """Store the part of the middle frame with most motion, from each [T, H, W] stack and from the codes, under
    OUT/crops.
    """
    middle = len(frames) // 2
    part = place(truth, frames[middle])
    pictures = {name: stack[middle][..., *part] for name, stack in stacks.items()}
    pictures["codes"] = codes.read(frames[middle], frames[middle] + 1)[0][part] / (codes.sensor.levels - 1)
    for name, picture in pictures.items():
        save_crop(crop_file(out, light, truth.clip.name, name), picture)


def sheet(
    out: Path,
    light: str,
    clips: Sequence[str],
    methods: Sequence[str],
    crops: Mapping[tuple[str, str], str],
    target: Path,
) -> bool:
    """Draw one row per clip and one column per method as PNG, peak = white, gamma 2.2.

    `crops` names the crop of each clip and method; without a name its place stays empty. Return False, and leave
    `target` as it is, if there are no crops, or named ones are missing.
    """
    rows = [clip for clip in clips if crop_file(out, light, clip, "truth").exists()][:SCENES_SHOWN]
    named = [crop_file(out, light, clip, name) for (clip, _), name in crops.items() if clip in rows]
    if not rows or not all(path.exists() for path in named):
        return False
    columns = ["truth", "codes", *methods]
    drawing = new_figure(1.5 * len(columns), 1.55 * len(rows) + 0.4)
    grid = drawing.subplots(len(rows), len(columns), squeeze=False)
    for clip, line in zip(rows, grid, strict=True):
        names = ["truth", "codes", *(crops.get((clip, method)) for method in methods)]
        for column, name, axes in zip(columns, names, line, strict=True):
            axes.set_xticks([])
            axes.set_yticks([])
            if name is not None and (path := crop_file(out, light, clip, name)).exists():
                picture = np.clip(load_array(path).astype(np.float32), 0, 1) ** (1 / 2.2)
                picture = picture if picture.ndim == 2 else np.moveaxis(picture, 0, -1)
                axes.imshow(picture, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
            if clip == rows[0]:
                axes.set_title(column, fontsize=8)
        line[0].set_ylabel(clip, fontsize=7)
    write_figure(drawing, target)
    return True
