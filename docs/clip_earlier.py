"""Renders frames with the program of commit 5c22140, whose folder is PYTHONPATH; clip_rows.py starts it.

    PYTHONPATH=FOLDER python docs/clip_earlier.py REQUEST.json OUT.npz

OUT holds `references` [2, judged, H, W], `pictures` [levels, judged, H, W] and, as JSON, `about` each level: budget and
processor seconds. It imports nothing of this folder but clip_parts.py, and the names of qsim are those of that commit.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
from clip_parts import meta, timed_frames
from qsim.budget import DEEPEST, Budget, choose
from qsim.render import Renderer
from qsim.writer import ClipWriter

import scenes
from qsim.scene import describe

TARGETS = {
    "qsim.render:Renderer.frame": "choice",
    "qsim.render:Renderer._pass": "paths",
    "qsim.render:Renderer.surfaces": "surfaces",
    "qsim.denoise:denoised": "denoiser",
    "qsim.translate:Stage.place": "scene",
    "qsim.render:Renderer.truth": "truth",
    "qsim.writer:ClipWriter.add": "writing",
}


def main(request: Path, out: Path) -> int:
    asked = json.loads(request.read_text())
    scene = scenes.load(asked["family"], seed=asked["scene_seed"], speed=asked["speed"])
    scene = scene.resized(asked["height"], asked["width"])
    deep = Renderer(scene, budget=Budget(asked["reference"], DEEPEST), seed=asked["seed"] + 1000)
    dr.set_thread_count(asked["threads"])
    references = [deep.halves([deep.time(t)], deep.budget, deep.key(t)) for t in asked["judged"]]
    pictures, about = zip(*(clip(scene, asked, level) for level in asked["levels"]), strict=True)
    np.savez(out, references=np.stack(references, axis=1), pictures=np.stack(pictures), about=json.dumps(about))
    return 0


def clip(scene: Any, asked: dict[str, Any], level: float) -> tuple[Any, dict[str, Any]]:
    """Return the judged frames [J, H, W] of a clip at a level [dB], and what they took."""
    started = time.process_time()
    budget = choose(scene, frames=asked["frames"], psnr=level, seed=asked["seed"])
    choosing = time.process_time() - started
    renderer = Renderer(scene, budget=budget, seed=asked["seed"])
    with tempfile.TemporaryDirectory() as folder:
        told = meta(scene, describe, len(asked["rendered"]), renderer.frame_rate)
        pictures, taken = timed_frames(renderer, ClipWriter(Path(folder) / "clip", told), asked["rendered"], TARGETS)
    about = {name: getattr(budget, name) for name in ("samples", "denoise", "bounces")}
    return np.stack([pictures[t] for t in asked["judged"]]), about | {"choosing_seconds": round(choosing, 2)} | taken


if __name__ == "__main__":
    sys.exit(main(*map(Path, sys.argv[1:])))
