"""Runs `qsim render`: renders a scene as a clip of stated error."""

from __future__ import annotations

import dataclasses
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from qsim import records
from qsim.backend import BACKENDS
from qsim.cli.command import Idle, command
from qsim.cli.completion import families
from qsim.cli.console import PILOT, RESUMES, bar, output
from qsim.kinds import FrameRate, Frames, Positive, Psnr, Seed, Shutter, Speed
from qsim.settings import setting


@dataclass(frozen=True)
class Render:
    """The clip that `qsim render` makes."""

    scene: Annotated[
        str,
        setting(
            "a family of scenes/, a .py file with scene(seed, speed=...), an animated .glb, Mitsuba .xml, a folder",
            positional=True,
            known=families,
        ),
    ]
    output: Annotated[Path | None, setting("clip folder to make (may be left out with --explain)", short="o")] = None
    explain: Annotated[bool, setting("print the modelled effects, and the size of the omitted ones")] = False
    seed: Annotated[Seed, setting("seed of the scene and its samples")] = 0
    speed: Annotated[Speed, setting("factor on all motions")] = 1.0
    frames: Annotated[Frames, setting("number of frames")] = 21
    height: Annotated[Frames | None, setting("pixels", unset="128; of a Mitsuba file its film's")] = None
    width: Annotated[Frames | None, setting("pixels", unset="128; of a Mitsuba file its film's")] = None
    frame_rate: Annotated[FrameRate, setting("frames per second")] = 2000.0
    shutter: Annotated[Shutter, setting("open fraction of a frame, 0..1", unset="0: sharp")] = 0.0
    psnr: Annotated[Psnr, setting("requested error of the radiance, in dB below white and clamped at white")] = 40.0
    bands: Annotated[Literal["rgb"] | None, setting("rgb: in colour, three bands", unset="one band")] = None
    camera_path: Annotated[
        Path | None,
        setting(
            "transforms.json whose poses, view and distortion the camera has",
            unset="the camera of the scene",
            shown="FILE",
        ),
    ] = None
    ppp: Annotated[
        Positive | None,
        setting(
            "highest light level you will sense, photons per pixel; sets samples so that the Monte-Carlo variance "
            "stays below 1 % of the shot variance"
        ),
    ] = None
    reuse: Annotated[
        bool | None,
        setting(
            "let sharp frames share samples with their neighbours, or render each frame alone",
            unset="share where that costs less, and trying it costs little against the clip",
        ),
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
    idle=[Idle(lambda asked: "" if asked.output else "replaces the clip of --output", ("force",))],
)
def render(asked: Render) -> int:
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
        raise FileExistsError(f"{asked.output}: exists; name another with -o, or use --force to replace it")
    if asked.engine is not None:
        os.environ["QSIM_ENGINE"] = asked.engine
        backend.choose()
    taken = {name: getattr(asked, name) for name in ("frames", "seed", "frame_rate", "shutter", "psnr", "ppp", "reuse")}
    size = {name: getattr(asked, name) for name in ("height", "width", "speed", "bands", "camera_path")}
    if asked.output is None:
        scene, _ = scene_rendering.load_scene(asked.scene, **size, seed=asked.seed, frame_rate=asked.frame_rate)
        chosen = choose_budget(scene, **taken)
        output({"render": dataclasses.asdict(chosen)}, explain(chosen.findings))
        return 0
    with bar(asked.output.name, first=PILOT) as progress:
        clip = scene_rendering.render(asked.scene, asked.output, **taken, **size, progress=progress, force=asked.force)
    info = clip.info
    work = info.render
    assert work is not None
    found = stated(info)
    text = f"{clip.path}: {len(clip)} frames of {clip.shape[1]} x {clip.shape[2]}"
    text += f", mean radiance {clip.mean_radiance:.4g} W/m2/sr"
    text += f", {clip.mean_photons:.4g} photons per pixel"
    if asked.scene.endswith(GLTF_SUFFIXES):
        text += f"\n{played(scenes.load(asked.scene, asked.seed, asked.speed))}"
    text += "" if found is None else f"\nerror: {found.line}"
    text += (missed := shortfall(found, asked.psnr)) and f"\nerror: {missed}"
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
    if not asked.explain and (asked.reuse or work.neighbours):
        text += "".join(f"\n{explain([one])}" for one in work.findings if one.effect == REUSE)
    if asked.explain or clip.camera is None:
        text += "\n" + explain(work.findings)
    else:
        text += "\n" + diffraction_line(clip.camera, clip.bands)
    facts = records.plain(info, complete=True)
    del facts["checksums"]
    output({"clip": str(clip.path)} | facts, text)
    return 0
