"""Renders one clip in one call: a scene record, a family, or a file with a scene."""

from __future__ import annotations

import math
import os
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Literal

from qsim import scenes
from qsim.clip.clip_info import Origin
from qsim.clip.manifest import target_of
from qsim.dataset import scene_files
from qsim.files import NAME, Progress
from qsim.host import own_numbers
from qsim.notebook import reporting
from qsim.rendering.budget import Budget
from qsim.rendering.clip_rendering import render_clip
from qsim.rendering.fidelity import choose_budget
from qsim.rendering.render_settings import SIDE, RenderSettings
from qsim.scene import Scene
from qsim.scene.animated.gltf_body import GLTF_SUFFIXES
from qsim.scene.animated.gltf_scene import cameras_in
from qsim.scene.camera_path import read_camera_path
from qsim.scenes.colours import coloured
from qsim.streams.clip import Clip
from qsim.temporary_folder import TemporaryFolder


@own_numbers
def render(  # noqa: PLR0913 (settings of a public function)
    scene: Scene | str | os.PathLike[str],
    path: str | os.PathLike[str] | None = None,
    *,
    frames: int = RenderSettings.frames,
    height: int | None = None,
    width: int | None = None,
    seed: int = 0,
    speed: float | None = None,
    frame_rate: float = RenderSettings.frame_rate,
    shutter: float = RenderSettings.shutter,
    psnr: float = RenderSettings.psnr,
    ppp: float | None = None,
    planes: int = 1,
    bands: Literal["rgb"] | None = None,
    camera_path: str | os.PathLike[str] | None = None,
    camera: str | None = None,
    start: float | None = None,
    reuse: bool | None = None,
    budget: Budget | None = None,
    progress: Progress | None = None,
    force: bool = False,
) -> Clip:
    """Render a scene at a stated error and return its clip: radiance, sharp frames and ground truth.

    `scene` is a `Scene`, or what `qsim render` takes: a family, a .py file with `scene(seed, *, speed)`, a .glb or
    .gltf with a camera or an animation, Mitsuba .xml, or a folder of assets. `height` and `width` [px] default to the
    camera of a `Scene` and to 128 of all others; one side of a file with a camera gives the other. `seed` is that of
    the scene and of its samples; `speed` is a factor on all motions (default 1). `frame_rate` is in frames per second,
    `shutter` the open fraction of a frame, 0 for sharp frames. `psnr` [dB] is the requested error, `ppp` the brightest
    light that will be sensed [photons per pixel and code] (`choose_budget`); a `budget` decides both instead. Of frames
    that codes will sum as `planes`, a code has that error. `bands="rgb"` gives a scene of one band colours
    (scenes/colours.py) and renders red, green and blue. `camera_path` is a transforms.json whose view, distortion and
    poses replace those of the scene's camera; a file that states no rate has one pose per frame
    (qsim/scene/camera_path.py). `camera` names a camera of a glTF file, else the seed chooses it, and `start` [s] is
    the time of its animations at the first frame. `reuse` True lets sharp frames share samples with their neighbours
    where that is predicted to cost less, None only where a trial costs little against the clip, False never.

    `path` is the folder of the clip; an equal call resumes an interrupted one. Without it, the clip lies in a temporary
    folder that is deleted after the last use of the clip and its streams. `progress(done, frames)` is called after each
    frame; a notebook shows a bar without it. `ValueError`, `FileNotFoundError` or `FileExistsError` where the arguments
    do not fit.

        clip = qsim.render("fan", frames=21, psnr=35)
    """
    if path is None and force:
        raise ValueError("force= replaces the clip of a folder, and no path is given; leave it out")
    if budget is not None and planes != 1:
        raise ValueError("planes= is part of the choice of a budget, and budget= replaces it; give one of them")
    if budget is not None and reuse is not None:
        raise ValueError("reuse= is part of the choice of a budget, and budget= replaces it; give one of them")
    settings = RenderSettings(
        frames=frames,
        height=height,
        width=width,
        frame_rate=frame_rate,
        shutter=shutter,
        psnr=psnr,
        bands=bands,
        camera_path=None if camera_path is None else os.fspath(camera_path),
        camera=camera,
        start=start,
        reuse=reuse,
    )
    if path is not None:
        target_of(path, force)  # before the pilot
    loaded, read = load_scene(scene, seed, speed, settings)
    if budget is None:
        budget = choose_budget(
            loaded,
            frame_rate=frame_rate,
            shutter=shutter,
            frames=frames,
            psnr=psnr,
            ppp=None if ppp is None else ppp / planes,
            planes=planes,
            codes=(planes,),
            reuse=reuse,
            seed=seed,
        )
    temporary = TemporaryFolder() if path is None else None
    name = loaded.name if NAME.fullmatch(loaded.name) else "scene"
    with reporting(progress, name) as heard:
        clip = render_clip(
            loaded,
            temporary.path / name if temporary else Path(path or ""),
            frames=frames,
            frame_rate=frame_rate,
            shutter=shutter,
            seed=seed,
            budget=budget,
            progress=heard,
            made_of=Origin(reads=read),
            force=force,
        )
    return replace(clip, keeps=temporary)


def load_scene(
    scene: Scene | str | os.PathLike[str], seed: int, speed: float | None, settings: RenderSettings
) -> tuple[Scene, dict[str, str]]:
    """Return a scene in its size, and the SHA-256 of each file that it reads; arguments and errors as of `render`."""
    height = settings.height
    width = settings.width
    bands = settings.bands
    path = settings.camera_path
    if isinstance(scene, Scene):
        if speed is not None:
            raise ValueError(f"scene {scene.name}: a Scene has its motions already; leave speed= out")
        scenes.check_view(scene.name, settings.camera, settings.start)
        size = height or scene.camera.height, width or scene.camera.width
        return in_bands(along_path(scene, path, settings.frame_rate, size).resized(*size), bands), {}
    name = os.fspath(scene)
    factor = 1.0 if speed is None else speed
    loaded, read = scene_files.load(
        name,
        seed,
        factor,
        along_path=path is not None,
        bands=bands,
        camera=settings.camera,
        start=settings.start,
    )
    framed = name.endswith(GLTF_SUFFIXES) and bool(cameras_in(name))
    size = size_of(loaded, height, width, framed=framed)
    if loaded.file is not None and path is None:
        _warn_of_another_view(loaded, size)
    seen = along_path(loaded, path, settings.frame_rate, size, factor).resized(*size)
    return seen if in_colour(loaded, name) else in_bands(seen, bands), read


def in_colour(scene: Scene, name: str) -> bool:
    """Return whether a scene was read in the colours of its files, of Mitsuba or of glTF."""
    of_files = scene.file is not None or name.endswith(GLTF_SUFFIXES) or Path(name).is_dir()
    return scene.bands is not None and of_files


def _warn_of_another_view(scene: Scene, size: tuple[int, int]) -> None:
    """Warn where frames of another shape than a Mitsuba file's film see less, or more, to the sides."""
    film = scene.camera
    shown = scene.camera.resized(*size)
    before, after = (2 * math.degrees(math.atan(camera.width / 2 / camera.focal_pixels)) for camera in (film, shown))
    if abs(after - before) > 0.01 * before + math.degrees(1 / shown.focal_pixels):
        warnings.warn(
            f"{scene.name}: the file's film is {film.height} x {film.width} pixels (height x width); at {size[0]} x "
            f"{size[1]} the vertical view stays, and the horizontal one is {after:.1f} instead of {before:.1f} degrees",
            stacklevel=3,
        )


def size_of(scene: Scene, height: int | None, width: int | None, *, framed: bool = False) -> tuple[int, int]:
    """Return (height, width) [px] of the frames: what is asked, else of a Mitsuba file its film's, else SIDE.

    One side alone keeps the shape of a Mitsuba file's film, or with `framed` that of the scene's camera, which then is
    SIDE high where no side is asked.
    """
    film = scene.camera
    if scene.file is None and not framed:
        return SIDE if height is None else height, SIDE if width is None else width
    if height is None and width is None:
        if not framed:
            return film.height, film.width
        height = SIDE
    if height is None:
        assert width is not None
        return max(1, round(width * film.height / film.width)), width
    return height, max(1, round(height * film.width / film.height)) if width is None else width


def along_path(
    scene: Scene,
    camera_path: str | os.PathLike[str] | None,
    frame_rate: float,
    size: tuple[int, int],
    speed: float = 1.0,
) -> Scene:
    """Return a scene seen by the camera of a transforms.json, or as it is without one; errors as of its reader.

    `size` (height, width) [px] is that of pictures whose size the file does not state.
    """
    if camera_path is None:
        return scene
    camera = read_camera_path(camera_path, scene.camera, frame_rate=frame_rate, speed=speed, size=size)
    return replace(scene, camera=camera)


def in_bands(scene: Scene, bands: Literal["rgb"] | None) -> Scene:
    """Return a scene as it is, or for "rgb" in colour. `ValueError` for a scene that has bands already."""
    if bands is None:
        return scene
    return coloured(scene)
