"""Estimates the light between the frames of a video: optical flow both ways, and occlusion by comparing the two.

    frames 0 and 1 -> flow 0 -> 1 and 1 -> 0 (dense inverse search, OpenCV) -> light at a share of the way from 0 to 1

At a share a of the way each pixel has one of three motions: the flow of frame 0 carried along, that of frame 1 carried
back, or their mean; the one whose ends in both frames look most alike. Its light is that of both ends, with the weights
1 - a and a. A point that frame 0 sees and frame 1 hides has no partner there: its flow to frame 1 and back does not
return. Such a point has the light of the frame that sees it, where the ends differ. Flow is found in pictures of 8
bits (light to the power 1 / 2.2), light is mixed where it is linear.

Left out: rolling shutter, blur of the exposure, and motion within a frame that is not straight.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.checks import ArgumentError
from qsim.formats.recording import Recording

SMALLEST = 12  # px, the larger side of frames with which the search begins
LARGEST = 32766  # px, either side
ALIKE = (0.01, 0.5)  # of Sundaram, Brox and Keutzer, ECCV 2010: |f + b|^2 < 0.01 (|f|^2 + |b|^2) + 0.5 px^2
UNLIKE = (4.0, 12.0)  # grey levels of 255 from which, and at which, ends differ
CUT = 0.2  # share of returning flow below which two frames hardly have the same points
_PATCH = 5  # px, over which ends are compared
_SHARE = 1e-9  # of a step: nearer to a frame than this it is the frame
_BRIGHTEST = 99.9  # percentile of light that is the white of the pictures for the search


class Between:
    """The light between two frames [H, W] of linear light."""

    def __init__(self, first: Array, second: Array) -> None:
        cv2 = _library()
        self._cv2 = cv2
        self._light = [np.ascontiguousarray(frame, np.float32) for frame in (first, second)]
        white = max(float(np.percentile(frame, _BRIGHTEST)) for frame in self._light) or 1.0
        shown = [_picture(frame, white) for frame in self._light]
        self._shown = [picture.astype(np.float32) for picture in shown]
        search = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        search.setFinestScale(0)
        self._forward = search.calc(shown[0], shown[1], None)
        self._back = search.calc(shown[1], shown[0], None)
        height, width = self._light[0].shape
        places = np.mgrid[:height, :width].astype(np.float32)
        self._y = places[0]
        self._x = places[1]
        self._seen = [  # 1 where the other frame shows the same point
            self._returns(self._forward, self._back),
            self._returns(self._back, self._forward),
        ]

    @property
    def returning(self) -> float:
        """The share of pixels whose flow there and back returns, 0 ... 1."""
        return float(np.mean([seen.mean() for seen in self._seen]))

    def at(self, share: float, masks: tuple[Array, Array] | None = None) -> tuple[Array, Array]:
        """Return light float32 [H, W] at a share of the way, and bool [H, W] where a pixel of the `masks` is in it."""
        share = float(share)  # NumPy's own would make float64 of all
        motion, unlike = self._motion(share)
        ends = [self._place(motion, -share), self._place(motion, 1 - share)]
        seen = [self._drawn(image, *end) for image, end in zip(self._seen, ends, strict=True)]
        differ = np.clip((unlike - UNLIKE[0]) / (UNLIKE[1] - UNLIKE[0]), 0, 1)
        first = (1 - share) * (1 - differ * seen[0] * (1 - seen[1]))  # less where frame 1 alone sees the point
        second = share * (1 - differ * seen[1] * (1 - seen[0]))
        total = first + second
        # Seen by neither frame, it is mixed by time alone.
        first = np.where(total > _SHARE, first / np.maximum(total, _SHARE), np.float32(1 - share))
        weights = [first, 1 - first]
        light = [self._drawn(image, *end) for image, end in zip(self._light, ends, strict=True)]
        mixed = weights[0] * light[0] + weights[1] * light[1]
        if masks is None or not any(mask.any() for mask in masks):
            return mixed, np.zeros(mixed.shape, bool)
        part = [self._drawn(mask.astype(np.float32), *end) for mask, end in zip(masks, ends, strict=True)]
        return mixed, weights[0] * part[0] + weights[1] * part[1] > 1e-3

    def _motion(self, share: float) -> tuple[Array, Array]:
        """Return the motion from 0 to 1 of what is at each pixel at a share of the way, and how unlike its ends are."""
        # Where motions cross, no single flow fits: forward, backward and their mean are tried at each pixel.
        candidates = (
            self._carried(self._forward, share),
            -self._carried(self._back, 1 - share),
            (1 - share) * self._forward - share * self._back,
        )
        chosen = candidates[0]
        least = self._unlike(chosen, share)
        for motion in candidates[1:]:
            unlike = self._unlike(motion, share)
            better = unlike < least
            least = np.where(better, unlike, least)
            chosen = np.where(better[..., None], motion, chosen)
        return chosen, least

    def _carried(self, flow: Array, share: float) -> Array:
        """Return the flow of the points that have gone a share of it: u(x) = flow(x - share u(x)), by three steps."""
        found = flow
        for _ in range(3):
            found = self._drawn(flow, *self._place(found, -share))
        return found

    def _unlike(self, motion: Array, share: float) -> Array:
        """Return how much both ends of a motion differ, mean of |grey levels| over a patch [H, W]."""
        ends = (self._place(motion, -share), self._place(motion, 1 - share))
        first, second = (self._drawn(image, *end) for image, end in zip(self._shown, ends, strict=True))
        return np.asarray(self._cv2.blur(np.abs(first - second), (_PATCH, _PATCH)))

    def _returns(self, there: Array, back: Array) -> Array:
        """Return 1 where the flow there and back returns, inside the frame, else 0; float32 [H, W]."""
        x, y = self._place(there, 1.0)
        height, width = x.shape
        returned = self._drawn(back, x, y)
        # A point that both frames show comes back to where it began (Sundaram, Brox and Keutzer, 2010).
        apart = ((there + returned) ** 2).sum(axis=-1)
        size = (there**2).sum(axis=-1) + (returned**2).sum(axis=-1)
        inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
        return (inside & (apart < ALIKE[0] * size + ALIKE[1])).astype(np.float32)

    def _place(self, motion: Array, share: float) -> tuple[Array, Array]:
        """Return x and y [H, W] of a share of a motion from each pixel."""
        return self._x + np.float32(share) * motion[..., 0], self._y + np.float32(share) * motion[..., 1]

    def _drawn(self, image: Array, x: Array, y: Array) -> Array:
        """Return an image [H, W] or [H, W, 2] at places, linear between pixels, with its edge beyond them."""
        cv2 = self._cv2
        return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def _picture(light: Array, white: float) -> Array:
    """Return light as a picture of 8 bits, brighter than `white` as white."""
    return np.rint(255 * np.clip(light / white, 0, 1) ** (1 / 2.2)).astype(np.uint8)


def at_rate(path: Path, recording: Recording, rate: float, frame_rate: float | None = None) -> Recording:
    """Return a recording of light at another rate [frames/s], with frames in between as they are estimated.

    Frames are at the times that the file states, or with `frame_rate` evenly. `ValueError` for codes, for one frame,
    for a rate below that of the file, and for frames of which no flow is found.
    """
    if not recording.is_light:
        raise ArgumentError("rate", f"estimates light between frames, and {path} holds codes; leave it out")
    times = _times(path, recording, frame_rate)
    seconds = float(times[-1])
    taken = (len(times) - 1) / seconds
    if rate < taken * (1 - 1e-6):
        raise ArgumentError(
            "rate", f"{rate:g} is below the {taken:.4g} frames per second of {path}; give more, or leave it out"
        )
    _, height, width = recording.shape
    if max(height, width) < SMALLEST or max(height, width) > LARGEST:
        raise ValueError(
            f"{path}: {height} x {width} pixels; flow is found in frames with a side of {SMALLEST} to {LARGEST} pixels"
        )
    frames = math.floor(seconds * rate + 1e-6) + 1
    found = _Estimated(recording, times, rate)
    said = (
        f"{len(times)} frames in {seconds:.4g} s by {_stated(recording, frame_rate)}; {frames} at {rate:g}/s, those "
        f"between by optical flow ({estimator()}); {_curve(recording)}; not modelled: rolling shutter, blur of the "
        "exposure, tone curves"
    )
    source = replace(recording.source, taken_rate=taken, estimator=estimator())
    return replace(
        recording,
        shape=(frames, height, width),
        read=lambda start, stop: found.marked(start, stop)[0],
        marked=found.marked,
        source=source,
        frame_rate=None,
        exposure=None,
        times=None,
        reading="; ".join(filter(None, (recording.reading, said))),
    )


def estimator() -> str:
    """Return the name and the version of what estimates motion."""
    return f"DIS, OpenCV {_library().__version__}"


def _library() -> Any:
    """Return OpenCV, whose types are incomplete."""
    import cv2

    return cv2


def _times(path: Path, recording: Recording, frame_rate: float | None) -> Array:
    """Return the time of each frame from the first [s], float64 [T], rising; `ValueError` where none are stated."""
    count = recording.shape[0]
    if count < 2:
        raise ArgumentError("rate", f"estimates light between two frames, and {path} has one; leave it out")
    if frame_rate is not None:
        return np.arange(count) / frame_rate
    times = recording.times
    if times is None or times.unit != "s":
        raise ArgumentError("frame_rate", f"{path}: states no times of its frames in seconds; give it, as in 30")
    found = np.array(times.values) - times.values[0]
    if not (np.diff(found) > 0).all():
        raise ArgumentError("frame_rate", f"{path}: the times of its frames do not rise; give it, as in 30")
    return found


def _stated(recording: Recording, frame_rate: float | None) -> str:
    """Return where the times of frames come from, as text."""
    if frame_rate is not None:
        return f"the given {frame_rate:g}/s"
    assert recording.times is not None
    return recording.times.source


def _curve(recording: Recording) -> str:
    """Return how light was read, as text."""
    source = recording.source
    black = "0" if source.black is None else f"{source.black:g}"
    white = "not known" if recording.white is None else f"{recording.white:g}"
    return f"light by {source.transfer or 'linear'}, black {black}, white {white}"


class _Estimated:
    """Frames at an even rate; two frames of the recording are held at a time."""

    def __init__(self, recording: Recording, times: Array, rate: float) -> None:
        self._recording = recording
        self._times = times
        self._rate = rate
        self._held: dict[int, tuple[Array, Array]] = {}
        self._pair: tuple[int, Between] | None = None
        self._told = False

    def marked(self, start: int, stop: int) -> tuple[Array, Array]:
        """Return light float32 and saturation bool [stop - start, H, W] of frames start ... stop - 1."""
        found = [self._frame(n / self._rate) for n in range(start, stop)]
        return np.stack([light for light, _ in found]), np.stack([mask for _, mask in found])

    def _frame(self, seconds: float) -> tuple[Array, Array]:
        last = len(self._times) - 2
        before = min(max(int(np.searchsorted(self._times, seconds, side="right")) - 1, 0), last)
        share = (seconds - self._times[before]) / (self._times[before + 1] - self._times[before])
        if share < _SHARE:
            return self._taken(before)
        if share > 1 - _SHARE:
            return self._taken(before + 1)
        first, second = (self._taken(t) for t in (before, before + 1))
        if self._pair is None or self._pair[0] != before:
            self._pair = before, Between(first[0], second[0])
            self._tell_cut(before, self._pair[1])
        return self._pair[1].at(float(share), (first[1], second[1]))

    def _tell_cut(self, before: int, between: Between) -> None:
        """Warn once of two frames of which hardly any flow returns."""
        if between.returning >= CUT or self._told:
            return
        self._told = True
        warnings.warn(
            f"between frames {before} and {before + 1} the flow of {100 * (1 - between.returning):.0f} % of the pixels "
            "does not return: a cut, or motion too fast; the light between them is no estimate (more may follow)",
            stacklevel=2,
        )

    def _taken(self, t: int) -> tuple[Array, Array]:
        """Return light and saturation of a frame of the recording, which are read once where frames rise."""
        if t not in self._held:
            self._held = {n: kept for n, kept in self._held.items() if n == t - 1}
            self._held[t] = self._read(t)
        return self._held[t]

    def _read(self, t: int) -> tuple[Array, Array]:
        marked: Any = self._recording.marked
        if marked is None:
            light = self._recording.read(t, t + 1)[0]
            return light, np.zeros(light.shape, bool)
        light, mask = marked(t, t + 1)
        return light[0], mask[0]
