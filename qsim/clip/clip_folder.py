"""Reads the frames of clip folders: radiance, sharp frames and ground truth.

    clip.json            shape, rates, units, camera, scene, render choices, errors, checksums; written last
    radiance/000000.exr  Y, or B G R of a colour clip, half, uncompressed: mean over the exposure
    sharp/000000.exr     the same at mid-exposure, only if it differs
    truth/000000.exr     u v bu bv valid Z id: flow to the next and the previous frame, validity, depth, body; zipped
    saturated/000000.exr 1 where light is a lower bound (see `Clip.saturated`), only for frames with such pixels; zipped
    streams/NAME.npy     codes, and NAME.json (stream.py)
    events/NAME.npy      events of an event camera, and NAME.json (event_stream.py)

A clip is written to NAME.part and renamed when complete; an interrupted run resumes there (writer.py).
"""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy import ndarray as Array

from qsim import opening
from qsim.checks import file_path
from qsim.clip import exr
from qsim.clip.clip_info import ClipInfo, frame_file
from qsim.clip.manifest import TRUTH, read_info
from qsim.host import own_numbers
from qsim.lazy_array import Crop, LazyArray
from qsim.optics.camera import Camera
from qsim.optics.radiometry import check_crop


@own_numbers
@dataclass(frozen=True, eq=False)
class ClipFolder:
    """A complete clip folder; frames are read on demand."""

    path: Path
    info: ClipInfo = None  # type: ignore[assignment]  # clip.json, which `open` reads
    keeps: object = field(default=None, repr=False)  # a temporary folder: it lasts as long as a reference to it

    def __post_init__(self) -> None:
        """Raise `ValueError` where the name of a folder stands alone: `open` reads its description."""
        if not isinstance(self.path, Path) or not isinstance(self.info, ClipInfo):
            kind = type(self).__name__
            raise ValueError(f"{kind}: a clip folder is opened by {kind}.open({str(self.path)!r})")

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> Self:
        """Open a clip; `FileNotFoundError` or `ValueError` if it is incomplete, damaged or of another version."""
        path = file_path(path)
        manifest = path / "clip.json"
        if not manifest.is_file():
            raise FileNotFoundError(_why_not(path))
        state = _state(manifest)
        found = cls(path, read_info(manifest))
        object.__setattr__(found, "_seen", state)
        return found

    def __len__(self) -> int:
        return self.info.shape[0]

    def __getitem__(self, index: Any) -> Array:
        """Return radiance as an array [T, H, W] would: `clip[3]` is float32 [H, W], `clip[2:5]` is [3, H, W].

        A colour clip is an array [T, 3, H, W].
        """
        return self._frames[index]

    def __iter__(self) -> Iterator[Array]:
        """Yield the radiance of each frame, float32 [H, W] or [3, H, W]."""
        return iter(self._frames)

    @property
    def _frames(self) -> LazyArray:
        def read(start: int, stop: int, crop: Crop | None) -> Array:
            return np.stack([self.radiance(t, crop) for t in range(start, stop)])

        frames, height, width = self.shape
        shape = self.shape if self.bands is None else (frames, 3, height, width)
        return LazyArray(shape, np.dtype(np.float32), read)

    @property
    def name(self) -> str:
        return self.info.name or self.path.name

    @property
    def shape(self) -> tuple[int, int, int]:
        """(frames, height, width)."""
        return self.info.shape

    @property
    def bands(self) -> tuple[float, float, float] | None:
        """Wavelengths [m] of the bands R, G, B of a colour clip; None: one band, at the camera's wavelength."""
        return self.info.bands

    @property
    def frame_rate(self) -> float:
        """Frames per second of the scene's time."""
        return self.info.frame_rate

    @property
    def exposure(self) -> float:
        """Seconds of light per frame."""
        return self.info.exposure

    @property
    def times(self) -> Array | None:
        """When each frame was taken, as the source of an imported clip states it, float64 [T]; None if it does not.

        `info.times` also holds the unit and the source. Frames are at even times elsewhere.
        """
        times = self.info.times
        return None if times is None else np.array(times.values, np.float64)

    @property
    def origin(self) -> tuple[int, int]:
        """(y, x) of the first pixel in the camera's frame: not (0, 0) if only a crop was rendered."""
        return self.info.origin

    @property
    def mean_radiance(self) -> float:
        """Mean over all frames, pixels and bands, in `info.radiance_unit`."""
        return self.info.mean_radiance

    @property
    def mean_photons(self) -> float:
        """Mean expected photons per pixel and exposure, without a light factor; `ValueError` for relative radiance.

        Of a colour clip it is the mean over the bands: the photons of one band.
        """
        if self.info.mean_photons is None:
            raise ValueError(f"{self.path}: its radiance is relative and has no photons; give a target in PPP")
        return self.info.mean_photons

    @property
    def strengths(self) -> dict[str, Array]:
        """The mean strength of each flickering light over the exposure of each frame, float64 [T]; 1 is its mean.

        `light0` is the first light of the scene, `body3` the glowing body of index 3. Empty without flicker.
        """
        return {name: np.array(light.strength) for name, light in self.info.flicker.items()}

    @property
    def camera(self) -> Camera | None:
        """The camera without its motion; None for relative radiance."""
        return self.info.camera

    def require_one_band(self, what: str) -> None:
        """Raise `ValueError` for a colour clip; `what` needs a clip of one band."""
        if self.bands is not None:
            raise ValueError(f"{self.path}: holds three bands, and {what} takes one; render the scene without bands")

    def radiance(self, t: int, crop: Crop | None = None) -> Array:
        """Return the mean radiance over the exposure of frame t, float32 [h, w]; crop = (y, x, height, width) [px].

        Of a colour clip it is [3, h, w], the bands R, G, B; so is `sharp`.
        """
        return self._half("radiance", t, crop)

    def sharp(self, t: int, crop: Crop | None = None) -> Array:
        """Return the radiance at mid-exposure, float32 [h, w], the target of restoration; `radiance` if not stored."""
        return self._half("sharp" if self.info.has("sharp", t) else "radiance", t, crop)

    def flow(self, t: int) -> Array:
        """Return flow, float32 [2, H, W] (u right, v down) [px]: p of frame t is at p + flow(p) in frame t + 1."""
        return np.stack([self._truth(t, "u"), self._truth(t, "v")])

    def flow_back(self, t: int) -> Array:
        """Return backward flow, float32 [2, H, W] [px]: p of frame t was at p + flow_back(p) in frame t - 1."""
        return np.stack([self._truth(t, "bu"), self._truth(t, "bv")])

    def valid(self, t: int) -> Array:
        """Return bool [H, W]: False where the point of frame t is hidden in, or outside of, frame t + 1."""
        return self._truth(t, "valid") != 0

    def depth(self, t: int) -> Array:
        """Return depth, float32 [H, W], metres along the optical axis; inf where no body is hit."""
        return self._truth(t, "Z")

    def body_id(self, t: int) -> Array:
        """Return the index of the visible body, int32 [H, W]; -1 where no body is hit."""
        return self._truth(t, "id").view(np.int32)

    def saturated(self, t: int, crop: Crop | None = None) -> Array:
        """Return bool [h, w]: True where the light of frame t is a lower bound.

        The camera of an imported video was saturated, or light was above 65504, the largest half.
        `info.saturated_pixels` counts them over all frames; `info.saturation` holds the pixel value.
        """
        self._check_frame(t)
        _, height, width = self.shape
        y, x, h, w = check_crop(crop, height, width, str(self.path))
        if not self.info.has("saturated", t):
            return np.zeros((h, w), bool)
        return self._channel("saturated", t, "saturated")[y : y + h, x : x + w] != 0

    @property
    def has_truth(self) -> bool:
        """Whether flow, validity, depth and body indices were stored."""
        return self.info.has("truth", 0)

    def holds(self, channel: str) -> bool:
        """Return whether the ground truth has a channel: u and v of flow, bu and bv of flow_back, valid, Z, id."""
        return self.has_truth and channel in self._channels("truth", 0)

    def channels_of_truth(self, t: int) -> frozenset[str]:
        """Return the channels of the ground truth of frame t, as `holds` names them."""
        return frozenset(self._channels("truth", t))

    def _half(self, folder: str, t: int, crop: Crop | None) -> Array:
        """Return an image of frame t in a folder, float32 [h, w] or [3, h, w]."""
        self._check_frame(t)
        _, height, width = self.shape
        if crop is not None:
            check_crop(crop, height, width, str(self.path))
        path = self.path / frame_file(folder, t)
        try:
            found = exr.read_half(path, height, width, crop, colour=self.bands is not None, beside=self.path)
        except FileNotFoundError:
            raise FileNotFoundError(
                f"{path}: no such file; the clip is damaged, run `qsim check {self.path}`"
            ) from None
        self._check_same()
        return found

    def _truth(self, t: int, channel: str) -> Array:
        return self._channel("truth", t, channel)

    def _channel(self, folder: str, t: int, channel: str) -> Array:
        """Return a channel [H, W] of frame t in a folder."""
        channels = self._channels(folder, t)
        if channel not in channels:
            path = self.path / frame_file(folder, t)
            raise ValueError(f"{path}: has no channel '{channel}' ({TRUTH.get(channel, channel)})")
        return channels[channel]

    def _channels(self, folder: str, t: int) -> dict[str, Array]:
        """Return all channels [H, W] of frame t in a folder by name."""
        self._check_frame(t)
        path = self.path / frame_file(folder, t)
        if not path.is_file():
            kept = self.info.has(folder, t)
            why = f"the clip is damaged, run `qsim check {self.path}`" if kept else f"frame {t} has no ground truth"
            raise FileNotFoundError(f"{path}: no such file; {why}")
        status = path.stat()
        opening.regular(path, beside=self.path)
        found = _read_truth(path, *self.shape[1:], status.st_mtime_ns, status.st_size)
        self._check_same()
        return found

    def _check_same(self) -> None:
        """Raise `ValueError` if the folder became another clip since this one was opened."""
        described = self.path / "clip.json"
        try:
            # The file's state is cheap to compare; checksums are read only where it has changed, as by a copy.
            state = _state(described)
            if state == getattr(self, "_seen", None):
                return
            same = read_info(described).checksums == self.info.checksums
        except FileNotFoundError:
            same = False
        if not same:
            raise ValueError(f"{described}: was replaced since it was opened; open the clip again")
        object.__setattr__(self, "_seen", state)

    def _check_frame(self, t: int) -> None:
        if not 0 <= t < len(self):
            raise ValueError(f"{self.path}: frame {t} does not exist; the clip has frames 0..{len(self) - 1}")


def _state(path: Path) -> tuple[int, ...]:
    """Return what tells a file from another of its name."""
    status = path.stat()
    return status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns


def _why_not(path: Path) -> str:
    """Return why a path is not a clip, and what to do."""
    if Path(f"{path}.part").is_dir():
        return f"{path}: unfinished (only {path.name}.part is there); run the same command again, it resumes"
    if not path.exists():
        return f"{path}: no such clip"
    if (path / "dataset.json").is_file():
        return f"{path}: is a data set, not a clip; its clips are in {path / 'clips'}"
    return f"{path}: not a clip folder (it has no clip.json)"


@functools.lru_cache(maxsize=2)
def _read_truth(path: Path, height: int, width: int, modified: int, size: int) -> dict[str, Array]:
    """Return the channels [H, W] by name; `modified` and `size` only key the cache, so that a changed file is read."""
    channels = exr.read(path, (height, width))
    for name, array in channels.items():
        if array.dtype != (np.uint32 if name in ("valid", "id", "saturated") else np.float32):
            raise ValueError(f"{path}: channel '{name}' is {array.dtype}; the file is damaged, run `qsim check`")
        array.setflags(write=False)
    return channels
