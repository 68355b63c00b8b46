"""Writes windows of codes with their truth and flow as one HDF5 file, for training in other programs.

    OUT.h5 / SPLIT (train, val, test; all for a clip) /
        codes   uint8 or, above 8 bits, uint16 [N, T, H, W]
        truth   float32 [N, T, H, W], in colour [N, T, 3, H, W]: sharp expected photons per pixel and code
        flow    float32 [N, T, 2, H, W], px from a code to the next (u right, v down); NaN where it is not known
        first, bits, ppp, exposure, frame_rate   [N]: frame of the stream, its bits, light, seconds and rate of a code
        clip, stream, sensor, code_model         [N]: names, sensor as JSON, how a code is made of its planes
        colour                                   [N]: colour filters from the first pixel on, as JSON; colour clips only

A window is T successive codes of a stream; windows do not overlap. One chunk holds one window.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.checks import ArgumentError
from qsim.clip.manifest import check_outside
from qsim.files import VERSION, Progress, replacing
from qsim.formats.hdf5_output import writable
from qsim.formats.summing import summed
from qsim.plane_sums import AS_STORED, PlaneSums
from qsim.streams.clip import Clip
from qsim.streams.code_truth import CodeTruth
from qsim.streams.stream import Stream

WINDOW = 11  # frames, as QUIVER takes them
Sensed = tuple[Clip, Stream]


@dataclass(frozen=True)
class Window:
    """Codes first ... first + frames - 1 of a stream of a clip."""

    clip: Clip
    stream: Stream
    first: int
    frames: int

    def codes(self) -> Array:
        """Return the codes [T, H, W]."""
        return self.stream.codes(self.first, self.first + self.frames)

    def truth(self) -> Array:
        """Return the sharp photons, float32 [T, H, W] or [T, 3, H, W]."""
        return self.stream.truth(self.first, self.first + self.frames).astype(np.float32)

    def flow(self) -> Array:
        """Return the flow, float32 [T, 2, H, W]; NaN where hidden or unknown, after the last code, and for rows that
        have their own time.
        """
        found = np.full((self.frames, 2, *self.clip.shape[1:]), np.nan, np.float32)
        truth = CodeTruth(self.clip, self.stream.timing)
        for n, t in enumerate(range(self.first, min(self.first + self.frames, len(self.stream) - 1))):
            flow, valid = truth.motion(t)
            found[n] = np.where(valid, flow, np.nan)
        return found

    def facts(self) -> dict[str, Any]:
        """Return what the file states of this window beside its arrays."""
        info = self.stream.info
        ppp = None if info.light is None else info.light.ppp
        sensor = json.dumps(info.sensor | ({"defects": info.defects} if info.defects else {}))
        light = {"bits": self.stream.bits, "ppp": np.nan if ppp is None else float(ppp)}
        rates = {"exposure": self.stream.exposure, "frame_rate": info.frame_rate}
        names = {"clip": self.clip.name, "stream": self.stream.name, "sensor": sensor}
        names |= {"code_model": info.code_model}
        if info.colour is not None:
            names["colour"] = json.dumps(info.colour.to_dict())
        return {"first": self.first} | light | rates | names


def streams_of(clips: Iterable[Clip]) -> list[Sensed]:
    """Return all streams of some clips, each with its clip."""
    return [(clip, clip.stream(name)) for clip in clips for name in clip.streams]


def windows(
    splits: Mapping[str, Sequence[Sensed]], frames: int, sums: PlaneSums = AS_STORED
) -> dict[str, list[Window]]:
    """Return the windows of all streams, by split; `ValueError` for none, and for clips of unequal sizes or bands.

    Streams of planes are summed as asked, from the first plane on: their truth is that of codes that follow each other.
    """
    for name in ("start", "stop", "every"):
        if getattr(sums, name) is not None:
            raise ArgumentError(name, "windows of pairs are made of all codes of a stream; leave it out")
    found: dict[str, list[Window]] = {}
    for split, sensed in splits.items():
        for clip, stored in sensed:
            if stored.shares is not None:
                raise ValueError(
                    f"{stored.path}: its codes have different exposures, those of a window have one; use another stream"
                )
            stream = summed(stored, sums)
            for first in range(0, len(stream) - frames + 1, frames):
                found.setdefault(split, []).append(Window(clip, stream, first, frames))
    if not found:
        number = sum(map(len, splits.values()))
        raise ValueError(
            f"no window of {frames} codes in {number} streams; make some with `qsim sense`, or give a smaller window="
        )
    every = [window for group in found.values() for window in group]
    sizes = {window.clip.shape[1:]: window.clip.name for window in every}
    if len(sizes) > 1:
        (one, a), (two, b) = list(sizes.items())[:2]
        raise ValueError(
            f"clips {a} and {b} are {one[0]} x {one[1]} and {two[0]} x {two[1]} px; convert them one by one"
        )
    coloured = {window.clip.bands is not None: window.clip.name for window in every}
    if len(coloured) > 1:
        raise ValueError(f"clip {coloured[True]} has three bands and {coloured[False]} one; convert them one by one")
    return found


def write(
    splits: Mapping[str, Sequence[Sensed]],
    path: Path,
    frames: int,
    *,
    sums: PlaneSums = AS_STORED,
    force: bool = False,
    progress: Progress | None = None,
) -> str:
    """Write windows of `frames` codes to an HDF5 file, complete or absent; return one line on its contents.

    `FileExistsError` if the file exists without `force`, or was not written by this function.
    """
    groups = windows(splits, frames, sums)
    _check_target(path, force)
    path.parent.mkdir(parents=True, exist_ok=True)
    total = sum(map(len, groups.values()))
    done = 0
    with replacing(path) as part, writable(part) as (file, check):
        file.attrs.update({"format": "qsim-pairs-1", "software": f"qsim {VERSION}", "truth": "photons"})
        for split, listed in groups.items():
            for _ in _fill(file.create_group(split), listed):
                done += 1
                check()
                if progress is not None:
                    progress(done, total)
    return _line(groups, frames)


def _fill(group: Any, listed: Sequence[Window]) -> Iterator[None]:
    """Write the windows of a split; yield after each."""
    import h5py

    height, width = listed[0].clip.shape[1:]
    shape = (listed[0].frames, height, width)
    bands = () if listed[0].clip.bands is None else (3,)
    kinds = {
        "codes": (np.uint16 if any(window.stream.bits > 8 for window in listed) else np.uint8, shape),
        "truth": (np.float32, (shape[0], *bands, height, width)),
        "flow": (np.float32, (shape[0], 2, height, width)),
    }
    arrays = {
        name: group.create_dataset(name, (len(listed), *size), dtype, chunks=(1, *size), compression="gzip")
        for name, (dtype, size) in kinds.items()
    }
    facts = [window.facts() for window in listed]
    for name in facts[0]:
        values = [fact[name] for fact in facts]
        group.create_dataset(name, data=values, dtype=h5py.string_dtype() if isinstance(values[0], str) else None)
    for n, window in enumerate(listed):
        arrays["codes"][n] = window.codes()
        arrays["truth"][n] = window.truth()
        arrays["flow"][n] = window.flow()
        yield


def _check_target(path: Path, force: bool) -> None:
    """Raise `FileExistsError` for a file that may not be replaced."""
    import h5py

    if path.suffix != ".h5":
        raise ValueError(f"{path}: pairs are written to one HDF5 file; name it .h5")
    check_outside(path)
    if not (path.exists() or path.is_symlink()):
        return
    if not force:
        raise FileExistsError(f"{path}: exists; name another, or replace it with force=True")
    ours = False
    if path.is_file() and not path.is_symlink() and h5py.is_hdf5(path):
        with h5py.File(path, "r") as file:
            ours = file.attrs.get("format") == "qsim-pairs-1"
    if not ours:
        raise FileExistsError(f"{path}: was not written by `qsim convert`; move it, or name another output")


def _line(groups: dict[str, list[Window]], frames: int) -> str:
    """Return what was written, and what was not."""
    every = [window for listed in groups.values() for window in listed]
    height, width = every[0].clip.shape[1:]
    counts = ", ".join(f"{len(listed)} {split}" for split, listed in groups.items())
    streams = {(window.clip.path, window.stream.name): len(window.stream) % frames for window in every}
    return (
        f"{len(every)} windows ({counts}) of {frames} codes of {height} x {width} pixels, from {len(streams)} streams: "
        "codes, truth in photons, flow in pixels; not written: depth, body indices, "
        f"and {sum(streams.values())} codes that fill no window"
    )
