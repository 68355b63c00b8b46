"""Makes the row of bit2bit, which has no training clips: it learns from each test stream, for a share of the time.

The stream of a clip holds the codes that `quiver evaluate` draws for all other methods. No sharp frame is used but to
score, and to choose the learning rate on a validation clip. One light level is scored: another would be another
training.
"""

from __future__ import annotations

import argparse
import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from rows import LIGHTS, Budget, best_rate, converged, kept_scores, quiver

from qsim.streams.storing import sense
from quiver.data.clips import Clip, open_clips
from quiver.data.codes import sensed
from quiver.data.illumination import Illumination
from quiver.evaluation.comparison import Comparison, ComparisonRow, restore_clip
from quiver.evaluation.json_values import json_safe
from quiver.evaluation.summary import summarise
from quiver.model.weights import metadata_of
from quiver.restoration.interface import RestoreOptions
from quiver.restoration.restorers import restorer

LIGHT = Illumination.of("quiver-physical", float(LIGHTS[0]), 3)
FRAMES = 16  # of a training window at most; a multiple of 8
BATCH = 1  # as published: a window has 16 frames


def stream_network(
    name: str, rates: tuple[str, ...], args: argparse.Namespace, budget: Budget
) -> tuple[dict[str, Any], Path]:
    """Return what the row of a network states that learns from the stream it restores, and one of its runs.

    `ValueError` for a data set without validation or test clips.
    """
    clips = clips_of(args.data, "test")
    first = clips_of(args.data, "val")[0]
    trials = {rate: {"psnr": trial(name, rate, first, args, budget)} for rate in rates}
    rate = best_rate(trials)
    minutes = budget.minutes / len(clips)
    runs = [learned(name, rate, minutes, clip, args, budget) for clip in clips]
    rows = [replace(restored(run, clip, args.data), method=name) for run, clip in zip(runs, clips, strict=True)]
    line = json_safe(asdict(summarise(rows)[0]))
    notes = [metadata_of(run / "best.safetensors") for run in runs]
    found = {
        "rate": float(rate),
        "trials": trials,
        "settings": json.loads(notes[0]["settings"]),  # those of the first clip
        "minutes_per_clip": minutes,
        "steps": sum(int(note["step"]) for note in notes),
        "scores": {line["light"]: kept_scores(line)},
    }
    return found, runs[0]


def clips_of(data: Path, split: str) -> list[Clip]:
    """Return the clips of a split. `ValueError` if there are none."""
    found = open_clips(data, split)
    if not found:
        raise ValueError(f"{data}: no clip in the split {split}, which this row needs; give a data set that has one")
    return found


def trial(name: str, rate: str, clip: Clip, args: argparse.Namespace, budget: Budget) -> float | None:
    """Return the matched PSNR [dB] of a clip after a short run on its stream; None if it diverged.

    `ValueError` if the clip cannot be restored.
    """
    runs: list[Path] = []
    if not converged(lambda: runs.append(learned(name, rate, budget.trial_minutes, clip, args, budget))):
        return None
    row = restored(runs[0], clip, args.data)
    if row.score is None:
        raise ValueError(f"{clip.name}, restored by {name}: {row.failure}")
    return row.score.psnr_matched


def learned(name: str, rate: str, minutes: float, clip: Clip, args: argparse.Namespace, budget: Budget) -> Path:
    """Train on the stream of one clip, unless it is done, and return the folder of the run."""
    copy = args.work / f"{name}_clips" / clip.name
    folder = args.work / f"{name}_{clip.name}_{rate}"
    shutil.copytree(clip.path, copy, dirs_exist_ok=True)
    sense(Clip.open(copy), LIGHT.sensing)
    frames = min(FRAMES, len(clip) // 8 * 8)
    quiver(
        *("train", copy, "-o", folder, "--preset", name, "--device", "cpu", "--minutes", minutes),
        *("--optimiser", "adam", "--learning-rate", rate),
        *("--crop", budget.crop, "--batch", BATCH, "--frames", frames, "-q"),
        budget=budget,
    )
    return folder


def restored(run: Path, clip: Clip, data: Path) -> ComparisonRow:
    """Return the scores of a clip restored by the weights of a run, from the codes that the run learned from."""
    codes, truth = sensed(clip, LIGHT)
    method = restorer(str(run), RestoreOptions(device="cpu"))
    return restore_clip(method, clip, LIGHT, Comparison(str(data), lights=(LIGHT,)), codes, truth)
