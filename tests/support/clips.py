"""Tiny clips and data sets for tests: a pattern that slides over the frame, written through qsim's own writers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim import descriptions
from qsim.clip.clip_info import PHYSICAL, RELATIVE
from qsim.clip.writer import ClipWriter
from qsim.dataset.dataset import Dataset
from qsim.dataset.generation import Options, generate
from qsim.dataset.job import Job
from qsim.dataset.recipe import Recipe
from qsim.optics.camera import Camera
from qsim.optics.radiometry import RGB
from qsim.rendering.render_settings import RenderSettings
from qsim.restored_video import RestoredInfo
from qsim.streams.clip import Clip

ClipMaker = Callable[..., Clip]


def sliding_pattern(frames: int, height: int, width: int, seed: int, speed: float = 1.5) -> Array:
    """Radiance [T, H, W]: random waves and a disk, moving `speed` px per frame to the right."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width].astype(float)
    waves = [(rng.uniform(0.1, 0.6), rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi)) for _ in range(4)]
    clip = np.empty((frames, height, width))
    for t in range(frames):
        moved = x - speed * t
        image = sum(np.sin(k * (moved * np.cos(a) + y * np.sin(a)) + p) for k, a, p in waves)
        disk = (moved % width - width / 2) ** 2 + (y - height / 2) ** 2 < (height / 5) ** 2
        clip[t] = 1.0 + 0.2 * image + 0.8 * disk
    return np.maximum(clip, 0.05)


def write_clip(
    path: Path,
    *,
    frames: int = 14,
    height: int = 36,
    width: int = 44,
    seed: int = 0,
    relative: bool = False,
    sharp: bool = False,
    error: float | None = 0.01,
    radiance: Array | None = None,
    flow: Array | None = None,
    **meta: object,
) -> Clip:
    stack = sliding_pattern(frames, height, width, seed) if radiance is None else radiance
    described = {
        "shape": [len(stack), *stack.shape[-2:]],
        "frame_rate": 2000.0,
        "exposure": 5e-4,
        "radiance_unit": RELATIVE if relative else PHYSICAL,
        "camera": None if relative else asdict(Camera(8e-3, 2.8, 1.1e-6, *stack.shape[-2:])),
        "scene": {"family": "sliding", "seed": seed},
    }
    with ClipWriter(path, described | meta) as writer:
        for t, frame in enumerate(stack):
            seen = np.ones(stack.shape[-2:], bool)
            truth = None if flow is None else {"flow": flow, "flow_back": -flow, "valid": seen}
            writer.add(t, frame, sharp=frame * 1.1 if sharp else None, truth=truth, error=error)
    return Clip.open(path)


def describe_video(path: Path, **about: Any) -> None:
    """Write the description NAME.json of restored video."""
    descriptions.write(path, RestoredInfo(**{"method": "moment", "seconds_per_frame": 0.1} | about))


def colour_clip(path: Path, frames: int = 3, height: int = 7, width: int = 9, **meta: object) -> Clip:
    """A clip of three bands whose patterns differ, of odd size unless others are given."""
    return write_clip(path, radiance=colour_pattern(frames, height, width), bands=list(RGB), **meta)


def colour_pattern(frames: int, height: int, width: int) -> Array:
    """Radiance [T, 3, H, W] of patterns that differ from band to band."""
    lit = ((1, 0.6), (2, 1.0), (3, 1.7))
    return np.stack([sliding_pattern(frames, height, width, seed) * light for seed, light in lit], axis=1)


def colour_dataset(path: Path, splits: dict[str, int], sensor: Any, **sensing: Any) -> Path:
    """A data set of three bands, each clip with a stream."""
    write_dataset(path, splits, radiance=colour_pattern(14, 36, 44), bands=list(RGB))
    for clip in Dataset.open(path).clips():
        clip.sense(sensor, **sensing)
    return path


def write_dataset(path: Path, splits: dict[str, int], **options: object) -> Path:
    """A data set folder with so many clips per split, generated with our pattern in place of a renderer."""
    settings = RenderSettings(frames=14, height=36, width=44, frame_rate=2000.0)
    jobs = tuple(Job(split, i, 1.0, split, settings, 0, ()) for split, count in splits.items() for i in range(count))

    def make(job: Job, target: Path) -> object:
        return write_clip(target, seed=job.scene_seed + 100 * len(job.split), job=job.digest, **options)

    generate(Recipe("tiny", jobs), path, Options(workers=0), make=make)
    return path


def square_clip(path, frames: int = 5, size: tuple[int, int] = (24, 33)) -> Clip:
    """A bright square that moves one pixel per frame, with its flow."""
    meta = {"shape": [frames, *size], "frame_rate": 2000.0, "exposure": 5e-4, "radiance_unit": RELATIVE}
    with ClipWriter(path, meta) as writer:
        for t in range(frames):
            radiance = np.full(size, 0.1, np.float32)
            radiance[6:12, 4 + t : 10 + t] = 1.0
            flow = np.zeros((2, *size), np.float32)
            flow[0, 6:12, 4 + t : 10 + t] = 1.0
            writer.add(t, radiance, truth={"flow": flow, "flow_back": -flow, "valid": np.ones(size, bool)}, error=0.01)
    return Clip.open(path)


def packed(planes: np.ndarray, path: Path) -> Path:
    """Binary planes [T, H, W], packed along the rows, as a .npy."""
    np.save(path, np.packbits(planes, axis=2))
    return path
