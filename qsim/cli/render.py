"""Runs `qsim render`: renders a scene as a clip of stated error."""

from __future__ import annotations

import argparse
import dataclasses
import math
import os
from pathlib import Path
from typing import Any

from qsim import checks, records
from qsim.backend import BACKENDS
from qsim.cli.console import PILOT, RESUMES, bar, command, output, refuse_idle
from qsim.cli.options import checked

LIGHT = (
    "highest light level you will sense, photons per pixel; sets samples so that the Monte-Carlo variance stays "
    "below 1 %% of the shot variance"
)


def add_render(sub: Any) -> None:
    """Add the command `render` to a program."""
    parser = command(
        sub,
        "render",
        _run_render,
        "Render a scene into a clip: radiance, sharp frames, flow, depth, body ids.",
        "qsim render fan -o out/fan --frames 21 --height 128 --width 128\nqsim render fan --explain",
        RESUMES,
        threads="threads of the renderer (Dr.Jit); the picture does not depend on it",
    )
    parser.add_argument(
        "scene",
        help="a family of scenes/, a .py file with scene(seed, speed=...), an animated .glb, Mitsuba .xml, a folder",
    )
    parser.add_argument("-o", "--output", type=Path, help="clip folder to make (may be left out with --explain)")
    parser.add_argument(
        "--explain", action="store_true", help="print the modelled effects, and the size of the omitted ones"
    )
    whole = checked(checks.whole)
    parser.add_argument(
        "--seed", type=checked(checks.seed), default=0, help="seed of the scene and its samples (default 0)"
    )
    parser.add_argument("--speed", type=checked(checks.speed), default=1.0, help="factor on all motions (default 1)")
    parser.add_argument("--frames", type=whole, default=21, help="number of frames (default 21)")
    parser.add_argument("--height", type=whole, help="pixels (default 128; of a Mitsuba file its film's)")
    parser.add_argument("--width", type=whole, help="pixels (default 128; of a Mitsuba file its film's)")
    rate, shutter, psnr = (checked(check) for check in (checks.frame_rate, checks.shutter, checks.psnr))
    parser.add_argument("--frame-rate", type=rate, default=2000.0, help="frames per second (default 2000)")
    parser.add_argument(
        "--shutter", type=shutter, default=0.0, help="open fraction of a frame, 0..1 (default 0: sharp)"
    )
    parser.add_argument(
        "--psnr",
        type=psnr,
        default=40.0,
        help="requested error of the radiance, in dB below white and clamped at white (default 40)",
    )
    parser.add_argument("--bands", choices=["rgb"], help="rgb: in colour, three bands (default: one band)")
    parser.add_argument(
        "--camera-path",
        type=Path,
        metavar="FILE",
        help="transforms.json whose poses, view and distortion the camera has (default: the camera of the scene)",
    )
    light = checked(checks.positive)
    parser.add_argument("--ppp", type=light, help=LIGHT)
    sharing = parser.add_mutually_exclusive_group()
    sharing.add_argument(
        "--reuse",
        action="store_true",
        default=None,
        help="let sharp frames share samples with their neighbours where that costs less (default: where trying it "
        "costs little against the clip)",
    )
    sharing.add_argument("--no-reuse", dest="reuse", action="store_false", default=None, help="render each frame alone")
    parser.add_argument("--engine", choices=BACKENDS, help="engine to use (default: QSIM_ENGINE, else the fastest)")
    parser.add_argument("--force", action="store_true", help="replace an existing clip")


def _run_render(args: argparse.Namespace) -> int:
    from qsim import backend, scenes
    from qsim.clip.clamped_error import stated
    from qsim.clip.exr import HALF_MAX
    from qsim.dataset.scene_rendering import load_scene, render
    from qsim.optics.diffraction import diffraction_line
    from qsim.rendering.budget import explain
    from qsim.rendering.fidelity import choose_budget, shortfall
    from qsim.rendering.reuse.sharing import NAME as REUSE
    from qsim.scene.animated.gltf_body import GLTF_SUFFIXES
    from qsim.scenes.gltf_file import played

    if args.output is None and not args.explain:
        raise ValueError("-o/--output is required (optional only with --explain)")
    if args.output is None:
        refuse_idle(args, "render without --output", ["force"])
    if args.output is not None and args.output.exists() and not args.force:
        raise FileExistsError(f"{args.output}: exists; name another with -o, or use --force to replace it")
    if args.engine is not None:
        os.environ["QSIM_ENGINE"] = args.engine
        backend.choose()
    taken = {name: getattr(args, name) for name in ("frames", "seed", "frame_rate", "shutter", "psnr", "ppp", "reuse")}
    size = {name: getattr(args, name) for name in ("height", "width", "speed", "bands", "camera_path")}
    if args.output is None:
        scene, _ = load_scene(args.scene, **size, seed=args.seed, frame_rate=args.frame_rate)
        chosen = choose_budget(scene, **taken)
        output(args, {"render": dataclasses.asdict(chosen)}, explain(chosen.findings))
        return 0
    with bar(args.output.name, first=PILOT) as progress:
        clip = render(args.scene, args.output, **taken, **size, progress=progress, force=args.force)
    info = clip.info
    work = info.render
    assert work is not None
    found = stated(info)
    text = f"{clip.path}: {len(clip)} frames of {clip.shape[1]} x {clip.shape[2]}"
    text += f", mean radiance {clip.mean_radiance:.4g} W/m2/sr"
    text += f", {clip.mean_photons:.4g} photons per pixel"
    if args.scene.endswith(GLTF_SUFFIXES):
        text += f"\n{played(scenes.load(args.scene, args.seed, args.speed))}"
    text += "" if found is None else f"\nerror: {found.line}"
    text += (missed := shortfall(found, args.psnr)) and f"\nerror: {missed}"
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
    if not args.explain and (args.reuse or work.neighbours):
        text += "".join(f"\n{explain([one])}" for one in work.findings if one.effect == REUSE)
    if args.explain or clip.camera is None:
        text += "\n" + explain(work.findings)
    else:
        text += "\n" + diffraction_line(clip.camera, clip.bands)
    facts = records.plain(info, complete=True)
    del facts["checksums"]
    output(args, {"clip": str(clip.path)} | facts, text)
    return 0
