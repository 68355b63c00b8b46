"""A clip: a folder with the radiance of a moving scene, its ground truth, and the streams sensed from it.

    clip.json            what it is: shape, rates, units, camera, scene, render choices, errors, checksums; written last
    radiance/000000.exr  Y, half, uncompressed: what a sensor integrates
    sharp/000000.exr     the same at mid-exposure, only where it differs
    truth/000000.exr     u v bu bv valid Z id: flow to the next and the previous frame, validity, depth, body; zipped
    streams/NAME.npy     codes, and NAME.json (stream.py)

A clip grows in NAME.part and gets its name when it is whole; an interrupted one goes on where it stopped.
"""

from __future__ import annotations

import functools
import importlib.metadata
import json
import math
import os
import shutil
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy import ndarray as Array

from qsim import __version__, exr, files, optics
from qsim.stream import Stream, check_crop, check_name, write_stream

if TYPE_CHECKING:
    from qsim.scene import Camera

__all__ = ["FORMAT_VERSION", "PHYSICAL", "RELATIVE", "Clip", "ClipWriter", "Stream", "write_stream"]

FORMAT_VERSION = 1
PHYSICAL = "W m^-2 sr^-1"
RELATIVE = "relative"
_TRUTH = {
    "u": "flow",
    "v": "flow",
    "bu": "flow_back",
    "bv": "flow_back",
    "valid": "valid",
    "Z": "depth",
    "id": "body_id",
}
_REQUIRED = ("shape", "frame_rate", "exposure", "radiance_unit", "mean_radiance", "checksums")


@dataclass(frozen=True, eq=False)
class Clip:
    """A finished clip folder; frames are read when asked for."""

    path: Path
    meta: dict[str, Any]  # clip.json

    @staticmethod
    def open(path: str | os.PathLike[str]) -> Clip:
        """`FileNotFoundError` or `ValueError`, naming file and key, if this is not a whole clip of our version."""
        path = Path(path)
        manifest = path / "clip.json"
        if not manifest.is_file():
            raise FileNotFoundError(_why_not(path))
        meta = files.read_json(manifest)
        files.check_version(manifest, meta.get("format_version"), FORMAT_VERSION)
        for key in _REQUIRED:
            if key not in meta:
                raise ValueError(f"{manifest}: key '{key}' is missing; the file is damaged")
        shape = meta["shape"]
        if not (isinstance(shape, list) and len(shape) == 3 and all(isinstance(n, int) and n > 0 for n in shape)):
            raise ValueError(f"{manifest}: shape must be [frames, height, width] of at least 1, found {shape!r}")
        if meta["radiance_unit"] not in (PHYSICAL, RELATIVE):
            raise ValueError(
                f"{manifest}: radiance_unit {meta['radiance_unit']!r}; known are '{PHYSICAL}' and '{RELATIVE}'"
            )
        return Clip(path, meta)

    def __len__(self) -> int:
        return int(self.meta["shape"][0])

    @property
    def name(self) -> str:
        return str(self.meta.get("name", self.path.name))

    @property
    def shape(self) -> tuple[int, int, int]:
        """(frames, height, width)"""
        frames, height, width = self.meta["shape"]
        return frames, height, width

    @property
    def frame_rate(self) -> float:
        """Frames per second of the scene's time."""
        return float(self.meta["frame_rate"])

    @property
    def exposure(self) -> float:
        """Seconds of light per frame."""
        return float(self.meta["exposure"])

    @property
    def origin(self) -> tuple[int, int]:
        """(y, x) of the first pixel in the camera's frame: not (0, 0) if only a crop was rendered."""
        y, x = self.meta.get("origin", (0, 0))
        return int(y), int(x)

    @property
    def mean_radiance(self) -> float:
        """Mean over all frames and pixels, in `meta["radiance_unit"]`."""
        return float(self.meta["mean_radiance"])

    @property
    def mean_photons(self) -> float:
        """Mean expected photons per pixel and exposure of the light as it is; `ValueError` for relative radiance."""
        value = self.meta.get("mean_photons")
        if value is None:
            raise ValueError(f"{self.path}: its radiance is relative and has no photons; give a target in PPP")
        return float(value)

    @cached_property
    def camera(self) -> Camera | None:
        """The camera without its motion; None for relative radiance."""
        described = self.meta.get("camera")
        if described is None:
            return None
        from qsim.scene import Camera

        values = {key: value for key, value in described.items() if key not in ("kind", "motion")}
        for key in ("origin", "target", "up"):
            if key in values:
                values[key] = tuple(values[key])
        try:
            return Camera(**values)
        except TypeError as error:
            raise ValueError(f"{self.path / 'clip.json'}: camera: {error}") from None

    def radiance(self, t: int, crop: optics.Crop | None = None) -> Array:
        """What the sensor integrates in frame t, float32 [H, W]; crop = (y, x, height, width)."""
        return self._half("radiance", t, crop)

    def sharp(self, t: int, crop: optics.Crop | None = None) -> Array:
        """The scene at mid-exposure, float32 [H, W], which a restorer should return; `radiance` where not stored."""
        return self._half("sharp" if f"sharp/{t:06d}.exr" in self.meta["checksums"] else "radiance", t, crop)

    def flow(self, t: int) -> Array:
        """float32 [2, H, W] (u right, v down) in pixels: pixel p of frame t is at p + flow(p) in frame t + 1."""
        return np.stack([self._truth(t, "u"), self._truth(t, "v")])

    def flow_back(self, t: int) -> Array:
        """float32 [2, H, W] (u right, v down) in pixels: pixel p of frame t was at p + flow_back(p) in frame t - 1."""
        return np.stack([self._truth(t, "bu"), self._truth(t, "bv")])

    def valid(self, t: int) -> Array:
        """bool [H, W]: False where the point of frame t is hidden in, or outside of, frame t + 1."""
        return self._truth(t, "valid") != 0

    def depth(self, t: int) -> Array:
        """float32 [H, W], metres along the optical axis; inf where nothing is."""
        return self._truth(t, "Z")

    def body_id(self, t: int) -> Array:
        """int32 [H, W]: number of the body seen, -1 where nothing is."""
        return self._truth(t, "id").view(np.int32)

    @property
    def has_truth(self) -> bool:
        """Whether flow, validity, depth and ids were stored."""
        return "truth/000000.exr" in self.meta["checksums"]

    @property
    def streams(self) -> tuple[str, ...]:
        """Names of the streams sensed from this clip."""
        return tuple(sorted(path.stem for path in (self.path / "streams").glob("*.json")))

    def stream(self, name: str) -> Stream:
        """`FileNotFoundError` that lists the streams there are."""
        path = self.path / "streams" / f"{name}.json"
        if not path.is_file():
            known = ", ".join(self.streams) or "none yet; make one with `qsim sense`"
            raise FileNotFoundError(f"{self.path}: no stream {name!r}; there are: {known}")
        return Stream.open(path)

    def verify(self) -> list[str]:
        """Problems of the folder in words, one per file; empty if every file is what was written."""
        problems = []
        for relative, expected in sorted(self.meta["checksums"].items()):
            path = self.path / relative
            if not path.is_file():
                problems.append(f"{path}: missing")
            elif files.sha256(path) != expected:
                problems.append(f"{path}: contents changed (checksum differs)")
        for path in sorted((self.path / "streams").glob("*.json")):
            try:
                problems += Stream.open(path).verify()
            except (ValueError, OSError) as error:
                problems.append(str(error))
        return problems

    def _half(self, folder: str, t: int, crop: optics.Crop | None) -> Array:
        self._check_frame(t)
        _, height, width = self.shape
        if crop is not None:
            check_crop(crop, height, width, str(self.path))
        return exr.read_half(self.path / folder / f"{t:06d}.exr", height, width, crop)

    def _truth(self, t: int, channel: str) -> Array:
        self._check_frame(t)
        path = self.path / "truth" / f"{t:06d}.exr"
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such file; this clip has no ground truth for frame {t}")
        status = path.stat()
        channels = _read_truth(path, status.st_mtime_ns, status.st_size)
        if channel not in channels:
            raise ValueError(f"{path}: has no channel '{channel}' ({_TRUTH[channel]})")
        return channels[channel]

    def _check_frame(self, t: int) -> None:
        if not 0 <= t < len(self):
            raise ValueError(f"{self.path}: frame {t} asked for, the clip has frames 0..{len(self) - 1}")


class ClipWriter:
    """Writes a clip frame by frame into PATH.part and gives it its name when all frames are there.

    `meta` is clip.json without what the writer measures (means, errors, checksums); it must hold shape, frame_rate,
    exposure and radiance_unit, and camera (a dict) unless the unit is relative. A writer with the same meta goes on
    where an interrupted one stopped: `has(t)` tells. `FileExistsError` if the clip exists and `force` is not set.
    """

    def __init__(self, path: str | os.PathLike[str], meta: dict[str, Any], *, force: bool = False) -> None:
        self.path = Path(path)
        self.force = force
        check_name(self.path.name)
        if self.path.exists() and not force:
            raise FileExistsError(f"{self.path}: exists; name another with -o, or use --force to replace it")
        self.meta = json.loads(files.to_json({"format_version": FORMAT_VERSION, "name": self.path.name} | meta))
        _check_new(self.path, self.meta)
        self.part = self.path.with_name(self.path.name + ".part")
        self._camera = Clip(self.path, self.meta).camera
        self._frames: dict[int, dict[str, Any]] = {}
        self._lock = files.Lock(self.part / "lock")

    def __enter__(self) -> ClipWriter:
        identity = files.to_json(self.meta)
        self.part.mkdir(parents=True, exist_ok=True)
        if not self._lock.acquire():
            raise ValueError(f"{self.part}: another process is writing this clip; wait for it, or name another with -o")
        try:
            begun = self.part / "begun.json"
            if not begun.is_file() or begun.read_bytes() != identity:
                for item in self.part.iterdir():
                    if item.name != "lock":
                        shutil.rmtree(item) if item.is_dir() else item.unlink()
                files.write_bytes(begun, identity)
            files.sweep(self.part)
            self._frames = _read_journal(self.part)
        except BaseException:
            self._lock.release()
            raise
        return self

    def has(self, t: int) -> bool:
        """Whether an earlier, interrupted writer already finished frame t."""
        return t in self._frames

    def add(
        self,
        t: int,
        radiance: Array,
        sharp: Array | None = None,
        truth: dict[str, Array] | None = None,
        error: float | None = None,
    ) -> None:
        """Store frame t: radiance [H, W], optionally the sharp instant, ground truth and the rms error of the radiance.

        `truth` may hold flow [2, H, W], flow_back [2, H, W], valid, depth, body_id [H, W]. `ValueError` for radiance
        that is negative or not finite, naming frame and pixel.
        """
        if not 0 <= t < self.meta["shape"][0]:
            raise ValueError(f"{self.path}: frame {t} does not belong to a clip of {self.meta['shape'][0]} frames")
        contents: dict[str, bytes] = {}
        half, clipped = self._encode(t, "radiance", radiance, contents)
        if sharp is not None:
            self._encode(t, "sharp", sharp, contents)
        if truth:
            contents[f"truth/{t:06d}.exr"] = exr.encode(_truth_channels(truth), compress=True)
        checksums = {}
        for relative, content in contents.items():
            target = self.part / relative
            target.parent.mkdir(exist_ok=True)
            checksums[relative] = files.write_bytes(target, content)
        stored = half.astype(np.float64)
        entry: dict[str, Any] = {
            "t": t,
            "checksums": checksums,
            "mean_radiance": float(stored.mean()),
            "clipped": clipped,
        }
        if error is not None:
            entry["error"] = float(error)
        if self._camera is not None:
            origin = tuple(self.meta.get("origin", (0, 0)))
            photons = optics.expected_photons(stored, self._camera, self.meta["exposure"], origin=origin)
            entry["mean_photons"] = float(photons.mean())
        self._frames[t] = entry
        with open(self.part / "journal.jsonl", "ab") as journal:
            journal.write(json.dumps(entry, sort_keys=True).encode() + b"\n")
            journal.flush()
            os.fsync(journal.fileno())

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._finish()
            elif not self._frames:
                shutil.rmtree(self.part)
        finally:
            self._lock.release()

    def _encode(self, t: int, folder: str, image: Array, contents: dict[str, bytes]) -> tuple[Array, int]:
        _, height, width = self.meta["shape"]
        if image.shape != (height, width):
            raise ValueError(f"{self.path}: {folder} of frame {t} is {image.shape}, expected {(height, width)}")
        bad = ~(np.isfinite(image) & (image >= 0))
        if bad.any():
            y, x = (int(i) for i in np.argwhere(bad)[0])
            raise ValueError(
                f"{self.path}: {folder} of frame {t} is {float(image[y, x])!r} at (y, x) = ({y}, {x}); "
                "radiance is finite and not negative"
            )
        half, clipped = exr.to_half(image)
        contents[f"{folder}/{t:06d}.exr"] = exr.encode({"Y": half})
        return half, clipped

    def _finish(self) -> None:
        frames = self.meta["shape"][0]
        missing = [t for t in range(frames) if t not in self._frames]
        if missing:
            raise ValueError(
                f"{self.path}: frame {missing[0]} was never written ({len(missing)} of {frames} are missing)"
            )
        entries = [self._frames[t] for t in range(frames)]
        meta = dict(self.meta)
        meta["mean_radiance"] = math.fsum(e["mean_radiance"] for e in entries) / frames
        if self._camera is not None:
            meta["mean_photons"] = math.fsum(e["mean_photons"] for e in entries) / frames
        meta["clipped_pixels"] = sum(e["clipped"] for e in entries)
        meta["checksums"] = {name: digest for e in entries for name, digest in e["checksums"].items()}
        meta["software"] = _software()
        if all("error" in e for e in entries):
            meta["error_per_frame"] = [e["error"] for e in entries]
            meta["psnr_of_truth"] = self._psnr(meta["error_per_frame"])
        files.write_json(self.part / "clip.json", meta)
        for name in ("begun.json", "journal.jsonl", "lock"):
            (self.part / name).unlink(missing_ok=True)
        if self.path.exists():
            files.remove_folder(self.path)
        os.replace(self.part, self.path)
        files.sync_folder(self.path.parent)

    def _psnr(self, errors: list[float]) -> float | None:
        """PSNR of the radiance, dB; the peak is the clip's 99.9th percentile (over at most 4 million even samples)."""
        frames, height, width = self.meta["shape"]
        step = max(1, math.isqrt(frames * height * width // 4_000_000))
        samples = [
            exr.read_half(self.part / "radiance" / f"{t:06d}.exr", height, width)[::step, ::step] for t in range(frames)
        ]
        peak = float(np.percentile(np.stack(samples), 99.9))
        rms = math.sqrt(math.fsum(e * e for e in errors) / frames)
        return 20 * math.log10(peak / rms) if peak > 0 and rms > 0 else None


def _why_not(path: Path) -> str:
    if path.with_name(path.name + ".part").is_dir():
        return f"{path}: unfinished (only {path.name}.part is there); run the command that made it again, it goes on"
    if not path.exists():
        return f"{path}: no such clip"
    if (path / "dataset.json").is_file():
        return f"{path}: is a data set, not a clip; its clips are in {path / 'clips'}"
    return f"{path}: not a clip folder (it has no clip.json)"


def _check_new(path: Path, meta: dict[str, Any]) -> None:
    shape = meta.get("shape")
    if not (isinstance(shape, list) and len(shape) == 3 and all(isinstance(n, int) for n in shape)):
        raise ValueError(f"{path}: shape must be [frames, height, width], got {shape!r}")
    if min(shape) < 1:
        raise ValueError(
            f"{path}: a clip needs at least one frame of one pixel, got {shape[0]} of {shape[1]} x {shape[2]}"
        )
    for key in ("frame_rate", "exposure"):
        value = meta.get(key)
        if not (isinstance(value, int | float) and value > 0):
            raise ValueError(f"{path}: {key} must be a number above 0, got {value!r}")
    if meta.get("radiance_unit") not in (PHYSICAL, RELATIVE):
        raise ValueError(
            f"{path}: radiance_unit must be '{PHYSICAL}' or '{RELATIVE}', got {meta.get('radiance_unit')!r}"
        )
    if (meta.get("camera") is None) != (meta["radiance_unit"] == RELATIVE):
        raise ValueError(f"{path}: a clip in {PHYSICAL} needs a camera, and a relative one has none")


def _truth_channels(truth: dict[str, Array]) -> dict[str, Array]:
    unknown = set(truth) - set(_TRUTH.values())
    if unknown:
        raise ValueError(
            f"truth: unknown key {sorted(unknown)[0]!r}; known are {', '.join(sorted(set(_TRUTH.values())))}"
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


def _read_journal(part: Path) -> dict[int, dict[str, Any]]:
    """Frames that an earlier writer finished; a line or file cut short by its death is dropped."""
    path = part / "journal.jsonl"
    if not path.is_file():
        return {}
    frames = {}
    kept = []
    for line in path.read_bytes().split(b"\n"):
        try:
            entry = json.loads(line)
        except ValueError:
            continue
        if all((part / name).is_file() and files.sha256(part / name) == d for name, d in entry["checksums"].items()):
            frames[int(entry["t"])] = entry
            kept.append(line)
    files.write_bytes(path, b"".join(line + b"\n" for line in kept))
    return frames


@functools.lru_cache(maxsize=2)
def _read_truth(path: Path, modified: int, size: int) -> dict[str, Array]:
    channels = exr.read(path)
    for array in channels.values():
        array.setflags(write=False)
    return channels


@functools.cache
def _software() -> dict[str, str]:
    versions = {name: importlib.metadata.version(name) for name in ("numpy", "mitsuba", "drjit")}
    return {"qsim": __version__} | versions
