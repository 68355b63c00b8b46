"""Runs `qsim render`: renders a scene as a clip of stated error."""

from __future__ import annotations

import dataclasses
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from qsim import records
from qsim.backend import BACKENDS
from qsim.cli.command import Idle, command
from qsim.cli.completion import families
from qsim.cli.console import PILOT, RESUMES, bar, output
from qsim.kinds import Frames, Positive, Seed, Speed
from qsim.rendering.render_settings import RenderSettings
from qsim.settings import setting


@dataclass(frozen=True)
class Render:
    """The scene that `qsim render` renders, and where its clip goes; how it is rendered are the `RenderSettings`."""

    scene: Annotated[
        str,
        setting(
            "a family of scenes/, a .py, .glb, .gltf or Mitsuba .xml file, a folder",
            positional=True,
            known=families,
        ),
    ]
    output: Annotated[Path | None, setting("clip folder to make (may be left out with --explain)", short="o")] = None
    explain: Annotated[bool, setting("print the modelled effects, and the size of the omitted ones")] = False
    seed: Annotated[Seed, setting("seed of the scene and its samples")] = 0
    speed: Annotated[Speed, setting("factor on all motions")] = 1.0
    ppp: Annotated[
        Positive | None,
        setting("brightest light you will sense, photons per pixel and code; sets the samples"),
    ] = None
    planes: Annotated[
        Frames | None,
        setting("frames that a code will sum as binary planes; they share its samples", unset="1"),
    ] = None
    engine: Annotated[str | None, setting("engine to use", unset="QSIM_ENGINE, else the fastest", choices=BACKENDS)] = (
        None
    )
    force: Annotated[bool, setting("replace an existing clip")] = False


@command(
    "qsim render fan -o out/fan --frames 21 --height 128 --width 128",
    "qsim render fan --explain",
    after_interrupt=RESUMES,
    threads="threads of the renderer (Dr.Jit); the picture does not depend on it",
    idle=[Idle(lambda asked, _: "" if asked.output else "replaces the clip of --output", ("force",))],
)
def render(asked: Render, settings: RenderSettings) -> int:
    """Render the clip and print its error, or explain the samples that it takes."""
    from qsim import backend, scenes
    from qsim.clip.clamped_error import stated
    from qsim.clip.exr import HALF_MAX
    from qsim.dataset import scene_rendering
    from qsim.optics.diffraction import diffraction_line
    from qsim.rendering.budget import explain
    from qsim.rendering.fidelity import choose_budget, shortfall
    from qsim.rendering.reuse.sharing import NAME as REUSE
    from qsim.scene.animated.gltf_body import GLTF_SUFFIXES
    from qsim.scenes.gltf_file import played

    if asked.output is None and not asked.explain:
        raise ValueError("-o/--output is required (optional only with --explain)")
    if asked.output is not None and asked.output.exists() and not asked.force:
        raise FileExistsError(f"{asked.output}: exists; name another, or replace it with --force")
    if asked.engine is not None:
        os.environ["QSIM_ENGINE"] = asked.engine
        backend.choose()
    planes = asked.planes or 1
    taken = {"seed": asked.seed, "ppp": asked.ppp} | {
        name: getattr(settings, name) for name in ("frames", "frame_rate", "shutter", "psnr", "reuse")
    }
    size = {"speed": asked.speed} | {
        name: getattr(settings, name) for name in ("height", "width", "bands", "camera_path", "camera", "start")
    }
    if asked.output is None:
        scene, _ = scene_rendering.load_scene(asked.scene, asked.seed, asked.speed, settings)
        light = None if asked.ppp is None else asked.ppp / planes
        chosen = choose_budget(scene, **taken | {"ppp": light}, planes=planes, codes=(planes,))
        output({"render": dataclasses.asdict(chosen)}, explain(chosen.findings))
        return 0
    with bar(asked.output.name, first=PILOT) as progress:
        clip = scene_rendering.render(
            asked.scene, asked.output, **taken, **size, planes=planes, progress=progress, force=asked.force
        )
    info = clip.info
    work = info.render
    assert work is not None
    found = stated(info)
    text = f"{clip.path}: {len(clip)} frames of {clip.shape[1]} x {clip.shape[2]}"
    text += f", mean radiance {clip.mean_radiance:.4g} W/m2/sr"
    text += f", {clip.mean_photons:.4g} photons per pixel"
    if asked.scene.endswith(GLTF_SUFFIXES):
        shown = scenes.load(asked.scene, asked.seed, asked.speed, camera=settings.camera, start=settings.start)
        text += f"\n{played(shown, asked.scene)}"
    text += "" if found is None else f"\nerror: {found.line}"
    text += (missed := shortfall(found, settings.psnr)) and f"\nerror: {missed}"
    if info.fireflies_per_frame:
        fireflies = sum(info.fireflies_per_frame)
        pixels = math.prod(clip.shape)
        how = "before denoising" if work.denoise else "not removed"
        text += f"\n{fireflies} of {pixels} pixels are fireflies (Monte-Carlo outliers); {how}"
    if cut := info.clipped_pixels:
        text += f"\n{cut} of {math.prod(clip.shape)} pixels are brighter than {HALF_MAX:g}, the most a clip holds"
        text += (
            ": cut off there, and left out of the scores of quiver"
            if info.saturated_pixels is not None
            else ": cut off there"
        )
    if not asked.explain and (settings.reuse or work.neighbours):
        text += "".join(f"\n{explain([one])}" for one in work.findings if one.effect == REUSE)
    if asked.explain or clip.camera is None:
        text += "\n" + explain(work.findings)
    else:
        text += "\n" + diffraction_line(clip.camera, clip.bands)
    facts = records.plain(info, complete=True)
    del facts["checksums"]
    output({"clip": str(clip.path)} | facts, text)
    return 0
