"""Writes clips frame by frame to NAME.part, which is renamed when it is complete."""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import json
import math
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim import descriptions, files, locks, opening, records, scratch
from qsim.arrays import plain
from qsim.clip import clamped_error, exr
from qsim.clip.clamped_error import StatedError
from qsim.clip.clip_info import ClipInfo, FrameFile, frame_file
from qsim.clip.manifest import OURS, TRUTH, check_replaced, info_of, read_info, target_of
from qsim.colour import bright_end
from qsim.files import VERSION, check_name
from qsim.host import own_numbers
from qsim.kinds import Count, Digest, NotNegative
from qsim.optics import radiometry
from qsim.parsing import require_readable


@dataclass(frozen=True, kw_only=True)
class FrameEntry:
    """A finished frame, one line of journal.jsonl."""

    t: Count
    checksums: dict[FrameFile, Digest]
    mean_radiance: NotNegative
    mean_photons: NotNegative | None = None
    largest: NotNegative  # radiance before it was rounded to halves
    clipped: Count  # pixels whose light is a lower bound
    saturated: Count | None = None  # the same, of imported frames and of those whose pixels are stored
    error: NotNegative | None = None  # rms
    errors_at: tuple[tuple[NotNegative, NotNegative], ...] = ()  # white, and the rms error clamped there
    fireflies: Count | None = None
    code_error: NotNegative | None = None  # rms, of the code in whose middle the frame is
    code_errors_at: tuple[tuple[NotNegative, NotNegative], ...] = ()  # as errors_at


@own_numbers
class ClipWriter:
    """Writes a clip frame by frame to PATH.part and renames it when all frames are stored.

    `info` describes the clip, as a record or as its values; what is measured (means, errors, checksums) is added. A
    writer with an equal description resumes where an interrupted one stopped: `has(t)` is true for its finished frames.
    `FileExistsError` if the clip exists and `force` is not set, or if the folder is not a clip. `ValueError` if
    PATH.part holds files of another origin, or, without `force`, frames of a clip with another description; at the end
    also for light too small for half floats.
    """

    def __init__(
        self, path: str | os.PathLike[str], info: ClipInfo | Mapping[str, Any], *, force: bool = False
    ) -> None:
        self.force = force
        self.name = check_name(Path(path).name)
        self.path = target_of(path, force)
        self.info = replace(info_of(self.path, info), name=self.name)
        require_readable(self.info.asked, f"{self.path}: its description")
        self.part = self.path.with_name(self.path.name + ".part")
        self._frames: dict[int, FrameEntry] = {}
        self._complete = False  # all frames and clip.json are stored
        self._lock = locks.Lock(self.part / "lock")

    def __enter__(self) -> ClipWriter:
        identity = files.to_json(self.info.asked)
        self._refuse_foreign()
        self.part.mkdir(parents=True, exist_ok=True)
        if not self._lock.acquire():
            raise ValueError(f"{self.part}: another process is writing this clip; wait for it, or name another")
        try:
            files.check_ours(self.part, rf"{OURS}|begun\.json|journal\.jsonl|lock")
            begun = self.part / "begun.json"
            if not begun.is_file():  # before anything is deleted: an interrupted clearing stays recognisable
                files.write_bytes(begun, self._identity_before() or identity)
            self._complete = self._is_complete()
            if opening.content(begun) != identity:
                left = self._finished()
                done = left.shape[0] if left is not None and self._complete else len(_read_journal(self.part))
                if done and not self.force:
                    raise ValueError(
                        f"{self.part}: {done} frames exist, begun with other settings, or another scene; "
                        "repeat those to resume, name another, or start again with force=True"
                    )
                self._clear()
                self._complete = False
                files.write_bytes(begun, identity)
            scratch.sweep(self.path.parent)
            self._frames = _read_journal(self.part)
        except BaseException:
            self._lock.release()
            raise
        return self

    def has(self, t: int) -> bool:
        """Return whether an earlier, interrupted writer finished frame t."""
        return self._complete or t in self._frames

    def add(  # noqa: PLR0913 (what a frame may hold)
        self,
        t: int,
        radiance: Array,
        sharp: Array | None = None,
        truth: dict[str, Array] | None = None,
        error: float | None = None,
        fireflies: int | None = None,
        errors_at: Sequence[Sequence[float]] = (),
        saturated: Array | None = None,
        code: StatedError | None = None,
    ) -> None:
        """Store frame t: radiance [H, W] in the clip's unit, and optionally its other images and errors.

        `sharp` [H, W] is the radiance at mid-exposure. `truth` may hold flow [2, H, W] and flow_back [2, H, W] in
        pixels, valid [H, W], depth [H, W] in m, body_id [H, W]. `error` is the rms error of the radiance. `errors_at`
        are pairs (white, rms error of radiance and truth clamped there), from which clip.json gets the error at its
        own white. `fireflies` counts the pixels with implausible samples. `code` is the error of the code in whose
        middle the frame is, where frames share the noise of a code.

        Images of a clip with `bands` are [3, H, W].

        `saturated` [H, W] is True where the camera was saturated: the radiance there is a lower bound. So it is where
        light is above the largest half. These pixels are counted in clip.json and, of a clip of one band, stored.

        A frame that an earlier writer stored with the same bytes is kept.

        `ValueError` for radiance that is negative or not finite; it names frame and pixel.
        """
        if not 0 <= t < self.info.shape[0]:
            raise ValueError(f"{self.path}: frame {t} does not belong to a clip of {self.info.shape[0]} frames")
        radiance = plain(radiance)
        contents: dict[str, bytes] = {}
        # Everything that is stated of a frame is that of its stored halves: a reader finds the same numbers.
        half = self._encode(t, "radiance", radiance, contents)
        lower = exr.above_half(radiance) if saturated is None else saturated | exr.above_half(radiance)
        if sharp is not None:
            self._encode(t, "sharp", sharp, contents)
            lower |= exr.above_half(sharp)
        if truth:
            contents[frame_file("truth", t)] = exr.encode(_truth_channels(truth), compress=True)
        mask = frame_file("saturated", t)
        if lower.any() and self.info.bands is None:
            contents[mask] = exr.encode({"saturated": lower.astype("<u4")}, compress=True)
        else:
            (self.part / mask).unlink(missing_ok=True)  # of an earlier writer
        earlier = self._frames.get(t)
        # A renderer that resumes may render a frame once more; equal bytes are not written again.
        if earlier and earlier.checksums == {name: files.sha256(content) for name, content in contents.items()}:
            return
        checksums = {}
        for relative, content in contents.items():
            target = self.part / relative
            target.parent.mkdir(exist_ok=True)
            checksums[relative] = files.write_bytes(target, content)
        stored = half.astype(np.float64)
        lost = float(np.sqrt(np.mean((stored - np.minimum(radiance, exr.HALF_MAX)) ** 2)))  # by rounding to halves
        clipped = int(np.count_nonzero(lower))
        stated = None if error is None else StatedError.of(error, errors_at).and_more(lost)
        of_code = None if code is None else code.and_more(lost)
        entry = FrameEntry(
            t=t,
            checksums=checksums,
            mean_radiance=float(stored.mean()),
            mean_photons=self._mean_photons(t, stored),
            largest=float(radiance.max()),
            clipped=clipped,
            saturated=clipped if saturated is not None or mask in contents else None,
            error=None if stated is None else stated.plain,
            errors_at=() if stated is None else stated.at_whites,
            fireflies=None if fireflies is None else int(fireflies),
            code_error=None if of_code is None else of_code.plain,
            code_errors_at=() if of_code is None else of_code.at_whites,
        )
        self._frames[t] = entry
        self._complete = False
        line = json.dumps(records.plain(entry), sort_keys=True)
        files.append_line(self.part / "journal.jsonl", line.encode())

    def _mean_photons(self, t: int, radiance: Array) -> float | None:
        """Return the mean of the expected photons of frame t, radiance [H, W] or [3, H, W]; None without a camera."""
        info = self.info
        if info.camera is None:
            return None
        camera = info.camera.at(t / info.frame_rate)
        if info.bands is None:
            photons = radiometry.expected_photons(radiance, camera, info.exposure, origin=info.origin)
        else:
            photons = radiometry.band_photons(radiance, camera, info.exposure, info.bands, origin=info.origin)
        return float(photons.mean())

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._finish()
            elif not (self._frames or self._complete):
                self._remove()
        finally:
            self._lock.release()

    def _finished(self) -> ClipInfo | None:
        """Return the description in .part of this clip, if the writer was killed during the rename."""
        with contextlib.suppress(OSError, ValueError):
            left = read_info(self.part / "clip.json")
            return left if left.name == self.name else None
        return None

    def _identity_before(self) -> bytes:
        """Return begun.json of a .part whose writer was killed during the rename; empty: it was killed at the start."""
        left = self._finished()
        return b"" if left is None else files.to_json(left.asked)

    def _refuse_foreign(self) -> None:
        """Raise `ValueError` unless .part is free, or what a writer of a clip of this name left there."""
        foreign = ValueError(f"{self.part}: was not written by qsim; move it away, or name another")
        if not self.part.exists() and not self.part.is_symlink():
            return
        if self.part.is_symlink() or not self.part.is_dir():
            raise foreign
        begun = self.part / "begun.json"
        with contextlib.suppress(ValueError):
            known = begun.is_file() and files.read_json(begun).get("name") == self.name
            started = all(item.name == "lock" or scratch.is_scratch(item) for item in self.part.iterdir())
            if known or started or self._finished() is not None:
                return
        raise foreign

    def _is_complete(self) -> bool:
        """Return whether the clip is complete except for the rename."""
        left = self._finished()
        if left is None:
            return False
        return not any(files.differs(self.part / name, digest) for name, digest in left.checksums.items())

    def _clear(self) -> None:
        """Delete the files of an earlier writer; begun.json, which marks the folder as a writer's, stays."""
        for item in self.part.iterdir():
            if item.name not in ("lock", "begun.json"):
                shutil.rmtree(item) if item.is_dir() else item.unlink()

    def _remove(self) -> None:
        self._clear()
        shutil.rmtree(self.part)

    def _encode(self, t: int, folder: str, image: Array, contents: dict[str, bytes]) -> Array:
        """Add the image [H, W] of frame t as EXR to `contents`; return it in half precision."""
        _, height, width = self.info.shape
        expected = (height, width) if self.info.bands is None else (3, height, width)
        if image.shape != expected:
            raise ValueError(f"{self.path}: {folder} of frame {t} is {image.shape}, expected {expected}")
        bad = ~(np.isfinite(image) & (image >= 0))
        if bad.any():
            y, x = (int(i) for i in np.argwhere(bad)[0][-2:])
            raise ValueError(
                f"{self.path}: {folder} of frame {t} is {float(image[bad][0])!r} at (y, x) = ({y}, {x}); "
                "radiance must be finite and not negative"
            )
        half = exr.to_half(image)
        channels = {"Y": half} if half.ndim == 2 else dict(zip("RGB", half, strict=True))
        contents[frame_file(folder, t)] = exr.encode(channels)
        return half

    def _finish(self) -> None:
        """Write clip.json and rename the folder; `ValueError` if a frame is missing.

        `FileExistsError` if the clip, or something else, exists by now and may not be replaced; .part stays complete.
        """
        frames = self.info.shape[0]
        missing = [t for t in range(frames) if not self.has(t)]
        if missing:
            raise ValueError(
                f"{self.path}: frame {missing[0]} was never written ({len(missing)} of {frames} are missing)"
            )
        if not self._complete:
            self._check_light(frames)
            self._write_info(frames)
        if self.path.exists() and not self.force:
            raise FileExistsError(
                f"{self.path}: appeared while this clip was made, which is complete in {self.part.name}; move it away "
                "and run the same command again"
            )
        check_replaced(self.path)
        # What only the writer needs goes before the rename: the clip's name stands for a clip and nothing else.
        for name in ("begun.json", "journal.jsonl", "lock"):
            (self.part / name).unlink(missing_ok=True)
        files.sync_folder(self.part)  # after a power cut the clip holds none of them
        if self.path.exists():
            files.remove_folder(self.path)
        os.replace(self.part, self.path)
        files.sync_folder(self.path.parent)

    def _check_light(self, frames: int) -> None:
        """Delete the frames and raise `ValueError` if halves hold their light in too few steps."""
        largest = max(self._frames[t].largest for t in range(frames))
        if 0 < largest < exr.SMALLEST:
            self._remove()
            raise ValueError(
                f"{self.path}: its largest light is {largest:.3g}, of which half floats keep fewer than 256 steps; "
                "multiply recorded light until its largest value is about 1, or brighten the scene"
            )

    def _write_info(self, frames: int) -> None:
        """Write clip.json: the description with what was measured."""
        entries = [self._frames[t] for t in range(frames)]
        means = [entry.mean_radiance for entry in entries]
        photons = [entry.mean_photons for entry in entries if entry.mean_photons is not None]
        saturated = [entry.saturated for entry in entries if entry.saturated is not None]
        fireflies = [entry.fireflies for entry in entries if entry.fireflies is not None]
        info = replace(
            self.info,
            mean_radiance=math.fsum(means) / frames,
            mean_photons=math.fsum(photons) / frames if photons else None,
            clipped_pixels=sum(entry.clipped for entry in entries),
            saturated_pixels=sum(saturated) if saturated else None,
            fireflies_per_frame=tuple(fireflies) if len(fireflies) == frames else (),
            checksums={name: digest for entry in entries for name, digest in entry.checksums.items()},
            software=_software(),
        )
        errors = [entry.error for entry in entries if entry.error is not None]
        if len(errors) == frames:
            shares = self.info.render is not None and self.info.render.neighbours > 0
            codes = {e.t: StatedError(e.code_error, e.code_errors_at) for e in entries if e.code_error is not None}
            found = clamped_error.measured(means, self._high(), errors, [e.errors_at for e in entries], shares, codes)
            info = replace(info, **vars(found))
        descriptions.write(self.part / "clip.json", info)

    def _high(self) -> float:
        """Return the 99.9th percentile of the radiance, over at most 4 million evenly spaced samples."""
        frames, height, width = self.info.shape
        # The same step along both axes, so that samples are even in space.
        step = max(1, math.isqrt(frames * height * width // 4_000_000))
        colour = self.info.bands is not None
        paths = [self.part / frame_file("radiance", t) for t in range(frames)]
        samples = [exr.read_half(path, height, width, colour=colour)[..., ::step, ::step] for path in paths]
        return bright_end(np.stack(samples))


def _truth_channels(truth: dict[str, Array]) -> dict[str, Array]:
    """Return the EXR channels [H, W] of the ground truth by name; `ValueError` for an unknown key."""
    unknown = set(truth) - set(TRUTH.values())
    if unknown:
        raise ValueError(
            f"truth: unknown key {sorted(unknown)[0]!r}; known are {', '.join(sorted(set(TRUTH.values())))}"
        )
    channels: dict[str, Array] = {}
    for key, names in (("flow", ("u", "v")), ("flow_back", ("bu", "bv"))):
        if key in truth:
            for name, plane in zip(names, truth[key], strict=True):
                channels[name] = plane.astype("<f4")
    if "valid" in truth:
        channels["valid"] = truth["valid"].astype("<u4")
    if "depth" in truth:
        channels["Z"] = truth["depth"].astype("<f4")
    if "body_id" in truth:
        channels["id"] = truth["body_id"].astype("<i4").view("<u4")
    return channels


def _read_journal(part: Path) -> dict[int, FrameEntry]:
    """Return the frames that an earlier writer finished; incomplete lines and files are dropped."""
    path = part / "journal.jsonl"
    if not path.is_file():
        return {}
    frames = {}
    kept = []
    for line in opening.content(path).split(b"\n"):
        try:
            entry = records.convert(json.loads(line), FrameEntry, str(path))
        except ValueError:
            continue
        if not any(files.differs(part / name, digest) for name, digest in entry.checksums.items()):
            frames[entry.t] = entry
            kept.append(line)
    files.write_bytes(path, b"".join(line + b"\n" for line in kept))
    return frames


@functools.cache
def _software() -> dict[str, str]:
    """Return the versions of qsim and the libraries that decide the radiance."""
    versions = {name: importlib.metadata.version(name) for name in ("numpy", "mitsuba", "drjit")}
    return {"qsim": VERSION} | versions
