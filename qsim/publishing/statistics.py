"""Counts what a published set holds, shard by shard: clips, frames, light and motion. Parts are added up."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from qsim.clip.motion_statistics import looks, moving_mean, moving_pixels
from qsim.kinds import Count, Digest, Number, Text
from qsim.publishing.contents import Sample
from qsim.streams.clip import Clip
from qsim.streams.stream_info import StreamInfo

PHOTOGRAPHS = "CC0 or public domain (a picture of the package scikit-image)"
UNKNOWN = "not recorded: a file of the maker of this set"


@dataclass(frozen=True, kw_only=True)
class Spread:
    """Smallest, mean and largest of some numbers."""

    count: Count = 0
    total: Number = 0.0
    least: Number = 0.0
    most: Number = 0.0

    @staticmethod
    def of(*values: float) -> Spread:
        """Return the spread of some numbers."""
        if not values:
            return Spread()
        return Spread(count=len(values), total=float(sum(values)), least=float(min(values)), most=float(max(values)))

    def __add__(self, other: Spread) -> Spread:
        if not (self.count and other.count):
            return self if self.count else other
        return Spread(
            count=self.count + other.count,
            total=self.total + other.total,
            least=min(self.least, other.least),
            most=max(self.most, other.most),
        )

    def words(self) -> str:
        """Return mean, smallest and largest: `3.25 (0.4 to 9.1)`."""
        if not self.count:
            return "-"
        mean = f"{self.total / self.count:.3g}"
        return mean if self.least == self.most else f"{mean} ({self.least:.3g} to {self.most:.3g})"


@dataclass(frozen=True, kw_only=True)
class Statistics:
    """What some clips hold."""

    clips: Count = 0
    frames: Count = 0
    pixels: Count = 0  # over all frames
    sizes: tuple[Text, ...] = ()  # frames x height x width of clips, at most `LISTED`
    rates: Spread = field(default_factory=Spread)  # frames per second
    photons: Spread = field(default_factory=Spread)  # expected per pixel and exposure, of each clip
    motion: Spread = field(default_factory=Spread)  # mean px/frame of what moves, of each clip
    moving: Spread = field(default_factory=Spread)  # share of pixels that move, of each clip
    error: Spread = field(default_factory=Spread)  # PSNR of the truth, dB
    ppp: dict[str, Spread] = field(default_factory=dict)  # of each stream: photons per pixel and code
    sensors: dict[str, Text] = field(default_factory=dict)  # of each stream
    licences: dict[str, Text] = field(default_factory=dict)  # of what went in
    files: dict[str, Digest] = field(default_factory=dict)  # the user's files that scenes read

    def __add__(self, other: Statistics) -> Statistics:
        sums: dict[str, Any] = {}
        for name, mine in vars(self).items():
            theirs = getattr(other, name)
            if name == "ppp":
                sums[name] = {key: mine.get(key, Spread()) + theirs.get(key, Spread()) for key in {**mine, **theirs}}
            elif name == "sizes":
                sums[name] = tuple(dict.fromkeys((*mine, *theirs)))[:LISTED]
            elif isinstance(mine, dict):
                sums[name] = dict(sorted({**mine, **theirs}.items())[:MOST])
            else:
                sums[name] = mine + theirs
        return Statistics(**sums)


LISTED = 8  # sizes that are named
MOST = 1000  # licences and files that are named


def statistics_of(sample: Sample) -> Statistics:
    """Return what one clip holds."""
    clip = sample.clip
    info = clip.info
    frames, height, width = clip.shape
    return replace(
        _motion(clip),
        clips=1,
        frames=frames,
        pixels=frames * height * width,
        sizes=(f"{frames} x {height} x {width}",),
        rates=Spread.of(info.frame_rate),
        photons=Spread() if info.mean_photons is None else Spread.of(info.mean_photons),
        error=Spread() if info.psnr_of_truth is None else Spread.of(info.psnr_of_truth),
        ppp={name: Spread.of(one.light.ppp) if one.light else Spread() for name, one in sample.streams.items()},
        sensors={name: _sensor(one) for name, one in sample.streams.items()},
        licences=_licences(clip),
        files={Path(name).name: digest for name, digest in info.reads.items() if "*" not in name},
    )


def _motion(clip: Clip) -> Statistics:
    """Return the motion of a clip, from its flow at some instants."""
    if not (clip.holds("u") and clip.holds("valid")):
        return Statistics()
    times = [t for t in looks(len(clip)) if clip.info.has("truth", t)]
    length = np.stack([np.where(clip.valid(t), np.hypot(*clip.flow(t)), np.nan) for t in times])
    mean = moving_mean(length)
    return Statistics(
        motion=Spread() if mean is None else Spread.of(mean), moving=Spread.of(float(moving_pixels(length).mean()))
    )


def _sensor(info: StreamInfo) -> str:
    """Return the sensor of a stream as text: name, model and bits."""
    model = str(info.sensor.get("model", "sensor"))
    name = info.sensor_name or model
    defects = ", with defects" if info.defects else ""
    return f"{Path(name).name} ({model}, {info.bits} bit{'s' * (info.bits > 1)}{defects})"


def _licences(clip: Clip) -> dict[str, str]:
    """Return the licences of the pictures and meshes of a clip, and of the recording that it was imported from."""
    found = {}
    for asset in clip.info.assets:
        kind, _, name = asset.partition(" ")
        if kind == "photograph":
            found[asset] = PHOTOGRAPHS
        elif "." in name:  # a file; of arrays that a scene computes only the digest is recorded
            found[f"{kind} {Path(name).name}"] = UNKNOWN
    for name in clip.info.reads:
        found[f"file {Path(name).name}"] = UNKNOWN
    if clip.info.source is not None:
        found[f"recording ({clip.info.source.format or 'imported'})"] = UNKNOWN
    return found
