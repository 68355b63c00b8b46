"""Renders all frames of a scene into a clip folder and resumes an interrupted one."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial

from qsim import files, records
from qsim.clip.clip_info import PHYSICAL, ClipInfo, FlickerInfo, Matrix, Origin, RenderInfo, SceneName
from qsim.clip.writer import ClipWriter
from qsim.host import own_numbers
from qsim.lazy_array import Crop
from qsim.rendering.behind import Behind
from qsim.rendering.budget import Budget
from qsim.rendering.engine import free_memory
from qsim.rendering.renderer import Frame, Renderer
from qsim.scene import Scene
from qsim.streams.clip import Clip


@own_numbers
def render_clip(  # noqa: PLR0913 (settings of a public function)
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
    made_of: Origin | None = None,
    force: bool = False,
) -> Clip:
    """Render frames 0 .. frames - 1 into a clip folder; an equal call with an equal scene resumes an interrupted one.

    `progress(done, frames)` is called after each frame. `made_of` states the job of a data set, the files of the scene;
    its scene is that of the record unless it names another.
    """
    if frames < 1:
        raise ValueError(f"{path}: a clip needs at least one frame, got {frames}")
    renderer = Renderer(
        scene, frame_rate=frame_rate, shutter=shutter, seed=seed, budget=budget, crop=crop, frames=frames
    )
    free_memory(renderer.engine)  # that of the clip before and of the budget's trials
    y, x, height, width = renderer.crop
    made_of = made_of or Origin()
    if made_of.scene is None:
        made_of = replace(made_of, scene=SceneName(family=scene.name, seed=scene.seed, speed=scene.speed))
    times = (renderer.time(t) for t in range(frames)) if scene.camera.motion is not None else ()
    poses = [scene.camera.pose(t).tolist() for t in times]
    info = ClipInfo(
        **vars(made_of),
        shape=(frames, height, width),
        origin=(y, x),
        frame_rate=frame_rate,
        shutter=shutter,
        exposure=(shutter if shutter > 0 else 1.0) / frame_rate,
        radiance_unit=PHYSICAL,
        camera=scene.camera,
        poses=records.convert(poses, tuple[Matrix, ...], "poses"),
        bands=scene.bands,
        flicker=_flicker_of(scene, renderer, frames),
        scene_sha256=files.sha256(json.dumps(scene.to_dict(), sort_keys=True).encode()),
        seed=seed,
        render=RenderInfo(**vars(renderer.budget), engine=renderer.engine.backend, variant=renderer.engine.variant),
    )

    def store(t: int, finished: Callable[[], Frame]) -> None:
        frame = finished()
        stated = (frame.error, frame.fireflies, frame.errors_at)
        writer.add(t, frame.radiance, frame.sharp, frame.truth, *stated, code=frame.code)

    tell = progress or (lambda done, frames: None)
    with ClipWriter(path, info, force=force) as writer, Behind() as behind:
        for t in range(frames):
            finished = None if writer.has(t) else renderer.begun(t)
            if behind.wait():
                tell(t, frames)
            if finished is None:
                tell(t + 1, frames)
            else:
                behind.start(partial(store, t, finished))
        if behind.wait():
            tell(frames, frames)
    return Clip.open(path)


def _flicker_of(scene: Scene, renderer: Renderer, frames: int) -> dict[str, FlickerInfo]:
    """Return the flickering lights of a scene with their strength over each frame."""
    if not scene.flickers:
        return {}
    strengths = renderer.strengths(frames)
    return {
        name: FlickerInfo(**asdict(flicker), kind=type(flicker).__name__, strength=tuple(strengths[name].tolist()))
        for name, flicker in scene.flickers.items()
    }
