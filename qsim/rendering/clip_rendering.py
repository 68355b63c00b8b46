"""Renders all frames of a scene into a clip folder and resumes an interrupted one."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from qsim import files
from qsim.clip.manifest import PHYSICAL
from qsim.clip.writer import ClipWriter
from qsim.rendering.budget import Budget
from qsim.rendering.engine import free_memory
from qsim.rendering.renderer import Crop, Renderer
from qsim.scene import Scene, describe
from qsim.streams.clip import Clip


def render_clip(
    scene: Scene,
    path: str | os.PathLike[str],
    *,
    frames: int,
    frame_rate: float = 2000.0,
    shutter: float = 0.0,
    seed: int = 0,
    budget: Budget | None = None,
    crop: Crop | None = None,
    progress: Callable[[int, int], None] | None = None,
    extra: dict[str, Any] | None = None,
    force: bool = False,
) -> Clip:
    """Render frames 0 .. frames - 1 into a clip folder; an equal call with an equal scene resumes an interrupted one.

    `progress(done, frames)` is called after each frame; `extra` is added to clip.json (the split of a
    data set, for example).
    """
    if frames < 1:
        raise ValueError(f"{path}: a clip needs at least one frame, got {frames}")
    renderer = Renderer(
        scene, frame_rate=frame_rate, shutter=shutter, seed=seed, budget=budget, crop=crop, frames=frames
    )
    free_memory(renderer.engine)  # that of the clip before and of the budget's trials
    y, x, height, width = renderer.crop
    meta = {
        "shape": [frames, height, width],
        "origin": [y, x],
        "frame_rate": frame_rate,
        "shutter": shutter,
        "exposure": (shutter if shutter > 0 else 1.0) / frame_rate,
        "radiance_unit": PHYSICAL,
        "camera": describe(scene.camera),
        "scene": {"family": scene.name, "seed": scene.seed, "speed": scene.speed},
        "scene_sha256": files.sha256(json.dumps(scene.to_dict(), sort_keys=True).encode()),
        "seed": seed,
        "render": asdict(renderer.budget) | {"engine": renderer.engine.backend, "variant": renderer.engine.variant},
    }
    if scene.camera.motion is not None:  # camera-to-world matrices at mid-exposure
        meta["poses"] = [scene.camera.pose(renderer.time(t)).tolist() for t in range(frames)]
    if scene.flickers:
        strengths = renderer.strengths(frames)
        meta["flicker"] = {
            name: {**asdict(flicker), "kind": type(flicker).__name__, "strength": strengths[name].tolist()}
            for name, flicker in scene.flickers.items()
        }
    if scene.bands is not None:
        meta["bands"] = list(scene.bands)
    with ClipWriter(path, meta | (extra or {}), force=force) as writer:
        for t in range(frames):
            if not writer.has(t):
                frame = renderer.frame(t)
                writer.add(t, frame.radiance, frame.sharp, frame.truth, frame.error, frame.fireflies, frame.errors_at)
            if progress is not None:
                progress(t + 1, frames)
    return Clip.open(path)
