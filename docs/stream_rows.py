"""Makes the row of bit2bit, which has no training clips: it learns from each test stream, for a share of the time.

The stream of a clip holds the codes that `quiver evaluate` draws for all other methods. No sharp frame is used but to
score, and to choose the learning rate on a validation clip. One light level is scored: another would be another
training.
"""

from __future__ import annotations

import argparse
import math
import shutil
import subprocess
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from rows import LIGHTS, Budget, kept_scores, quiver

from qsim.clip.sensing import sense
from quiver.cli.train import DIVERGED
from quiver.data.clips import Clip, open_clips
from quiver.data.codes import sensed
from quiver.data.illumination import Illumination
from quiver.evaluation.comparison import Comparison, ComparisonRow, json_safe, restore_clip
from quiver.evaluation.summary import summarise
from quiver.model.weights import metadata_of
from quiver.restoration.restorers import restorer

LIGHT = Illumination("quiver-physical", float(LIGHTS[0]), 3)
FRAMES = 16  # of a training window at most; a multiple of 8
BATCH = 1  # as published: a window has 16 frames


def stream_network(name: str, rates: tuple[str, ...], args: argparse.Namespace, budget: Budget) -> dict[str, Any]:
    """Return what the row of a network states that learns from the stream it restores: trials, scores and steps."""
    clips = open_clips(args.data, "test")
    first = open_clips(args.data, "val")[0]
    trials = {rate: {"psnr": trial(name, rate, first, args, budget)} for rate in rates}
    rate = max(trials, key=lambda key: trials[key]["psnr"] or -math.inf)
    results = [learned(name, rate, budget.minutes / len(clips), clip, args, budget) for clip in clips]
    line = json_safe(asdict(summarise([replace(row, method=name) for row, _ in results])[0]))
    return {
        "rate": float(rate),
        "trials": trials,
        "minutes_per_clip": budget.minutes / len(clips),
        "steps": sum(int(metadata_of(folder / "best.safetensors")["step"]) for _, folder in results),
        "folder": str(results[0][1]),
        "scores": {line["light"]: kept_scores(line)},
    }


def trial(name: str, rate: str, clip: Clip, args: argparse.Namespace, budget: Budget) -> float | None:
    """Return the matched PSNR [dB] of a clip after a short run on its stream; None if it diverged or failed."""
    try:
        score = learned(name, rate, budget.trial_minutes, clip, args, budget)[0].score
    except subprocess.CalledProcessError as failed:
        if failed.returncode != DIVERGED:
            raise
        return None
    return None if score is None else score.psnr_matched


def learned(
    name: str, rate: str, minutes: float, clip: Clip, args: argparse.Namespace, budget: Budget
) -> tuple[ComparisonRow, Path]:
    """Train on the stream of one clip, restore it, and return its scores and the folder of the run."""
    copy, folder = args.work / f"{name}_clips" / clip.name, args.work / f"{name}_{clip.name}_{rate}"
    if not copy.exists():
        shutil.copytree(clip.path, copy)
    sense(Clip.open(copy), LIGHT.sensing(0))
    frames = min(FRAMES, len(clip) // 8 * 8)
    quiver(
        *("train", copy, "-o", folder, "--preset", name, "--minutes", minutes, "--optimiser", "adam"),
        *("--learning-rate", rate, "--crop", budget.crop, "--batch", BATCH, "--frames", frames, "-q"),
        budget=budget,
    )
    codes, factor = sensed(clip, LIGHT)
    comparison = Comparison(str(args.data), lights=(LIGHT,))
    return restore_clip(restorer(str(folder)), clip, LIGHT, comparison, codes, factor), folder
