"""Restores cubes of the Single Photon Challenge and writes the zip of pictures that a submission is.

    SCENE/000000.npy ...  ->  OUT.zip with SCENE/000000.png (sRGB uint8 [H, W, 3], the last plane), and OUT.json

OUT.json states method, time and, where the truth lies beside a cube, the PSNR of its picture. Both appear when they are
complete, the json last.
"""

from __future__ import annotations

import io
import math
import time
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy import ndarray as Array

from qsim import descriptions, files
from qsim.colour import psnr
from qsim.files import VERSION, Progress
from qsim.kinds import Count, NotNegative, Number, Planes, Text
from quiver.data.challenge import COLOURS, Cube, band_codes, light_of_band, picture
from quiver.restoration.interface import Restorer
from quiver.restoration.restored_file import check_finite

_DATE = (1980, 1, 1, 0, 0, 0)  # of every picture: the same pictures make the same zip


@dataclass(frozen=True, kw_only=True)
class SubmissionInfo:
    """The description of a submission: OUT.json without its format version and its own checksum."""

    FORMAT: ClassVar[str] = "quiver-submission"

    method: Text
    description: str = ""  # of the method, in words
    identity: dict[str, Any] = field(default_factory=dict)  # settings and weights of the method
    planes_per_code: Planes
    pictures: Count
    psnr: Number | None = None  # dB, mean over the pictures whose truth is known
    psnr_of_pictures: dict[str, Number | None] = field(default_factory=dict)  # dB, by SCENE/NUMBER
    seconds_per_picture: NotNegative
    quiver: str = ""  # version of the program


def restore_cubes(
    cubes: Sequence[Cube],
    method: Restorer,
    planes: int,
    path: Path,
    progress: Progress | None = None,
    *,
    force: bool = False,
) -> SubmissionInfo:
    """Write the last planes of cubes, restored from codes of `planes` planes, to PATH.zip; return its description.

    `FileExistsError` for a result without `force`, and for files that this function did not write; `ValueError` for
    cubes of one name, and for a truth that is damaged or of another size.
    """
    check_target(path, force)
    names = [cube.name for cube in cubes]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"{path}: two cubes are called {twice[0]}; a submission has one picture of each name")
    for cube in cubes:  # a damaged truth is found before hours of work
        cube.truth()
    scores: dict[str, float | None] = {}
    started = time.perf_counter()
    with files.replacing_described(path, path.with_suffix(".json")) as (packed, described):
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_STORED) as archive:
            for done, cube in enumerate(cubes):
                if progress is not None:
                    progress(done, len(cubes))
                truth = cube.truth()
                made = restore_last(cube, method, planes)
                archive.writestr(zipfile.ZipInfo(f"{cube.name}.png", _DATE), _png(made))
                scores[cube.name] = None if truth is None else picture_psnr(made, truth)
        known = [score for score in scores.values() if score is not None]
        info = SubmissionInfo(
            quiver=VERSION,
            method=method.name,
            description=method.description,
            identity=dict(method.identity),
            planes_per_code=planes,
            pictures=len(cubes),
            psnr=sum(known) / len(known) if known else None,
            psnr_of_pictures=scores,
            seconds_per_picture=(time.perf_counter() - started) / len(cubes),
        )
        described.write(files.to_json(descriptions.values_of(info)))
    if progress is not None:
        progress(len(cubes), len(cubes))
    return info


def restore_last(cube: Cube, method: Restorer, planes: int) -> Array:
    """Return the picture of the last plane, sRGB uint8 [H, W, 3], from codes that sum `planes` planes each."""
    restored = []
    for colour in range(len(COLOURS)):
        codes = band_codes(cube, colour, planes)
        last = codes.shape[0] - 1
        video = method.restore(codes, last if method.seamless else 0, last + 1)
        check_finite(video[-1:], method.name, last)
        restored.append(video[-1])
    return picture(light_of_band(restored, planes))


def picture_psnr(made: Array, truth: Array) -> float:
    """Return the PSNR [dB] of 8-bit pictures [H, W, 3], below 255 over all values; 100 for equal ones."""
    error = math.sqrt(float(np.mean((made.astype(float) - truth) ** 2)))
    return min(psnr(255.0, error), 100.0)


def check_target(path: Path, force: bool) -> None:
    """Raise `FileExistsError` if PATH.zip or PATH.json exists and may not be replaced."""
    description = path.with_suffix(".json")
    for file in (path, description):
        if (file.exists() or file.is_symlink()) and not force:
            raise FileExistsError(f"{file}: exists; name another, or replace it with force=True")
    there = path.exists() or path.is_symlink() or description.exists()
    ours = description.is_file() and files.read_json(description).get("format") == SubmissionInfo.FORMAT
    if there and (not ours or path.is_dir() or path.is_symlink()):
        raise FileExistsError(
            f"{path}: is not a submission with its .json, which is all that is replaced; name another"
        )


def _png(picture: Array) -> bytes:
    from PIL import Image

    packed = io.BytesIO()
    Image.fromarray(picture).save(packed, format="png")
    return packed.getvalue()
