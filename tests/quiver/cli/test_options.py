"""Every option of `quiver` has an effect or is refused: a new option fails until it has a row in this table."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from clips import write_clip, write_dataset
from golden import TINY, fill_by_rule, published_state
from option_rows import Acts, Refused, Row, Run, check, loudness, names, names_of, options, stdout
from safetensors.numpy import load_file

from qsim import figures
from qsim.sensor import devices
from qsim.streams.sensing import Sensing
from qsim.streams.storing import sense
from quiver import threads
from quiver.baselines import METHODS
from quiver.cli import program
from quiver.evaluation import cost, domain_measurement
from quiver.model import presets
from quiver.model.presets import ABLATIONS, PRESETS
from quiver.model.quiver import QUIVER
from quiver.model.unet import UNet, UNetConfig
from quiver.model.weights import save
from quiver.restoration import domain, restorers
from quiver.restoration.domain import Cell, Domain
from quiver.training import loop

# ---- What is compared


def tensors(run: Run) -> dict[str, Any]:
    """Return the weights in the files that a command writes, without their metadata."""
    files = sorted(run.folder.rglob("*.safetensors"))
    return {
        path.relative_to(run.folder).as_posix(): {name: value.tobytes() for name, value in load_file(path).items()}
        for path in files
    }


def history(run: Run) -> list[dict[str, float]]:
    """Validations of a training run, without times."""
    found = json.loads((run.folder / "run/history.json").read_text())["history"]
    return [{name: value for name, value in entry.items() if name != "elapsed"} for entry in found]


def scores(run: Run) -> list[Any]:
    """Scores of the rows of `quiver evaluate` and `ablate`, and whether one failed; no labels, no times."""
    found = json.loads(next(run.folder.rglob("table/evaluation.json")).read_text())
    return [(row["score"], row["failure"], row["truth_psnr"]) for row in found["rows"]]


def static_scores(run: Run) -> list[Any]:
    return [{name: value for name, value in row.items() if name != "method"} for row in json.loads(run.out)["scores"]]


def cells(run: Run) -> list[Any]:
    """What was measured in the cells of a domain, without their names."""
    return [(cell["network"], cell["classical_psnr"]) for cell in json.loads(run.out)["domain"]["cells"]]


def costs(run: Run) -> list[Any]:
    """PSNR and multiply-accumulates of the rows of `quiver bench`: what does not depend on the machine."""
    text = (run.folder / "b/bench.json").read_text() if (run.folder / "b").exists() else run.out
    return [(row["psnr_matched"], row["gmac_per_frame"]) for row in json.loads(text)["costs"]]


def is_json(run: Run) -> bool:
    """Whether stdout is one JSON object."""
    try:
        return isinstance(json.loads(run.out), dict)
    except json.JSONDecodeError:
        return False


SEEN: dict[Path, dict[str, list[Any]]] = {}


def see(what: str, value: Any) -> None:
    SEEN.setdefault(Path.cwd(), {}).setdefault(what, []).append(value)


def seen(what: str) -> Callable[[Run], list[Any]]:
    """Return what the program did in a folder: torch's threads, frames per read, worker processes, cells measured."""
    return lambda run: SEEN[run.folder.resolve()].get(what, [])


# ---- Rows

TRAIN = "train data -o run --preset unet --protocol control --steps 2 --crop 16 --batch 1"
RESUMED = TRAIN.replace("-o run", "-o trained")
STREAM = "restore two/streams/p3.npy -o r.npy --method moment"
CLIP = "restore clip --ppp 3 -o r.npy --method moment"
BARE = "restore codes.npy --sensor quiver-paper -o r.npy --method moment"
GAIN = "restore codes.npy --ppp 3 -o r.npy --method moment"  # of a sensor whose gain follows the light
ZIP = "restore cubes -o r.zip --method moment:3"
CUBE = "restore cube.npy --width 24 --sensor spad-320x240 -o r.npy --method moment"
NET = "restore clip --ppp 3 -o r.npy --method small.safetensors --mode streaming -q"  # the quickest mode
UNET = "restore clip --ppp 3 -o r.npy --method unet.safetensors"
SCORE = "evaluate clip -o table --methods naive"
SCORE_NET = "evaluate clip -o table --methods small.safetensors --mode streaming"
SCORE_UNET = "evaluate clip -o table --methods unet.safetensors"
STORED = "evaluate two -o table --methods naive --stream p3"
COUNTS = "evaluate --static counts.npy --methods naive --splits 1 --json"
PLANES = "evaluate --static planes.npy --width 24 --frames 3 --methods naive --splits 1 --json"
CELLS = "domain unet.safetensors clip --methods naive --json"
CELLS_NET = "domain small.safetensors clip --methods naive --mode streaming --json"
SHOW = "domain measured.safetensors"
ABLATE = "ablate data -o six --steps 1 --crop 8 --batch 1 --mode streaming"
BENCH = "bench --methods small.safetensors --modes streaming --size 16x16 --json"
BENCH_UNET = "bench --methods unet.safetensors --size 16x16 --json"
BENCH_CLASSICAL = "bench --methods moment --size 16x16 --json"
CONVERT = "convert-weights their.pth -o ours.safetensors"


def their_weights(folder: Path) -> None:
    """A checkpoint of the published network."""
    torch.save(_published(), folder / "their.pth")


_published = cache(published_state)


def three_frames(method: str) -> str:
    """The option --memory with what a classical method needs for blocks of three frames of 16 x 24."""
    return f"--memory {16 * 24 * (METHODS[method].bytes_per_pixel + 3 * restorers.FRAME_BYTES)}"


def of_torch(command: str) -> list[Row]:
    return [
        Acts(f"{command} --threads 1", "--threads 2", seen("threads")),
        Refused(command, "--threads 5", "this machine has 4 cores"),
    ]


def of_training(option: str, value: str, *more: Row, resumed: str = "") -> list[Row]:
    """An option that changes weights, and that a run which has begun refuses."""
    typed = f"{option} {value}"
    return [Acts(TRAIN, typed, tensors), Refused(RESUMED, typed, resumed or "holds a run with"), *more]


def of_measuring(option: str, value: str, *rows: Row) -> list[Row]:
    return [*rows, Refused(SHOW, f"{option} {value}".strip(), "no clips are given")]


def of_clips(option: str, value: str, *rows: Row) -> list[Row]:
    return [*rows, Refused(COUNTS, f"{option} {value}".strip(), "--static")]


ROWS: dict[tuple[str, str], list[Row]] = {
    ("", "--version"): [Acts("", "--version", stdout, codes=(0, 2))],
    **loudness(
        {
            "train": TRAIN,
            "restore": CLIP,
            "evaluate": SCORE,
            "domain": SHOW,
            "ablate": ABLATE,
            "bench": BENCH,
            "convert-weights": CONVERT,
            "completion": "completion bash",
        }
    ),
    ("train", "--json"): [Acts(TRAIN, "--json", is_json)],
    ("restore", "--json"): [Acts(CLIP, "--json", is_json)],
    ("evaluate", "--json"): [Acts(SCORE, "--json", is_json), Acts(COUNTS.replace(" --json", ""), "--json", is_json)],
    ("domain", "--json"): [Acts(SHOW, "--json", is_json)],
    ("ablate", "--json"): [Acts(ABLATE, "--json", is_json)],
    ("bench", "--json"): [Acts(BENCH_CLASSICAL.replace(" --json", ""), "--json", is_json)],
    ("convert-weights", "--json"): [Acts(CONVERT, "--json", is_json, before=their_weights)],
    ("completion", "--json"): [Acts("completion bash", "--json", is_json)],
    # train
    ("train", "--output"): [Acts(TRAIN, "-o other", names), Refused(TRAIN, "-o clip", "is not a training run")],
    ("train", "--preset"): of_training("--preset", "quiver-s"),
    ("train", "--protocol"): of_training("--protocol", "spad-sum"),
    ("train", "--start"): of_training(
        "--start", "trained", Refused(TRAIN, "--start small.safetensors", "the preset unet")
    ),
    ("train", "--steps"): of_training("--steps", "3"),
    ("train", "--minutes"): of_training("--minutes", "1e-7"),
    ("train", "--sensor"): of_training(
        "--sensor", "quiver-published", Refused(TRAIN, "--sensor carries.toml", "training windows cannot follow")
    ),
    ("train", "--ppp"): of_training("--ppp", "9"),
    ("train", "--temperature"): [
        Refused(TRAIN, "--temperature 30", "temperature"),
        Refused(f"{TRAIN} --sensor spad-320x240", "--temperature 30", "no law of temperature"),
    ],
    ("train", "--bits"): of_training(
        "--bits", "1", Refused(f"{TRAIN} --sensor spad.toml", "--bits 2", "the file has bits = 1")
    ),
    ("train", "--crop"): of_training("--crop", "8", Refused(TRAIN, "--crop 6", "needs a multiple of 4")),
    ("train", "--frames"): of_training(
        "--frames", "12", Refused(TRAIN, "--frames 10", "at least 11"), Refused(TRAIN, "--frames 13", "window needs 13")
    ),
    ("train", "--batch"): of_training("--batch", "2"),
    ("train", "--optimiser"): of_training("--optimiser", "muon"),
    ("train", "--learning-rate"): of_training("--learning-rate", "0.03"),
    ("train", "--schedule"): of_training("--schedule", "plateau"),
    ("train", "--loss"): of_training("--loss", "paper"),
    ("train", "--validate-every"): [
        Acts(TRAIN, "--validate-every 1", history),
        Refused(TRAIN.replace("--steps 2", "--minutes 1e-7"), "--validate-every 1", "of a run with --steps"),
        Refused(RESUMED, "--validate-every 1", "holds a run with validate_every"),
    ],
    ("train", "--validation-split"): [
        Acts(TRAIN, "--validation-split test", history),
        Refused(TRAIN.replace("data", "lone"), "--validation-split test", "no clip in that split"),
        Refused(RESUMED, "--validation-split test", "holds a run with validation_split"),
    ],
    ("train", "--workers"): [Acts(TRAIN, "--workers 1", seen("workers"))],
    ("train", "--threads"): of_torch(TRAIN),
    ("train", "--precision"): of_training("--precision", "bfloat16"),
    ("train", "--device"): [Refused(TRAIN, "--device cuda", "no CUDA device")],
    ("train", "--seed"): of_training("--seed", "1"),
    ("train", "--force"): [
        Acts(f"{RESUMED} --seed 1", "--force", tensors, codes=(0, 2)),
        Refused(TRAIN.replace("-o run", "-o clip"), "--force", "only what this program made is removed"),
    ],
    # restore
    ("restore", "--output"): [
        Acts(CLIP, "-o s.npy", names),
        Acts(ZIP, "-o s.zip", names),
        Refused(CLIP, "-o r.mp4", "written as .npy"),
    ],
    ("restore", "--method"): [Acts(CLIP, "--method naive"), Acts(CLIP, "--method small.safetensors")],
    ("restore", "--stream"): [
        Refused(ZIP, "--stream p1", "whose layout states it"),
        Acts("restore two --stream p3 -o r.npy --method moment", "--stream p1"),
        Refused(STREAM, "--stream p1", "names a stream of a clip"),
        Refused(BARE, "--stream p1", "names a stream of a clip"),
        Refused(CLIP, "--stream p1", "p1"),
    ],
    ("restore", "--sensor"): [
        Refused(ZIP, "--sensor quiver-paper", "whose layout states it"),
        Acts(CLIP, "--sensor quiver-published"),
        Acts(f"{BARE} --bits 1", "--sensor spad-320x240"),
        Acts(CUBE, "--sensor spad512s"),
        Refused(STREAM, "--sensor quiver-paper", "is a stored stream"),
        Refused("restore one -o r.npy --method moment", "--sensor quiver-paper", "is a stored stream"),
    ],
    ("restore", "--ppp"): [
        Refused(ZIP, "--ppp 9", "whose layout states it"),
        Acts(CLIP, "--ppp 9"),
        Acts("restore one -o r.npy --method moment", "--ppp 3.25"),
        Acts(GAIN, "--ppp 9"),
        Refused(BARE, "--ppp 9", "does not follow the light"),
        Refused(STREAM, "--ppp 9", "is a stored stream"),
    ],
    ("restore", "--bits"): [
        Refused(ZIP, "--bits 1", "whose layout states it"),
        Acts(CLIP, "--bits 1"),
        Acts(BARE, "--bits 4"),
        Refused(STREAM, "--bits 1", "is a stored stream"),
        Refused(CUBE, "--bits 2", "planes are 1-bit codes"),
    ],
    ("restore", "--seed"): [
        Refused(ZIP, "--seed 1", "whose layout states it"),
        Acts(CLIP, "--seed 1"),
        Refused(BARE, "--seed 1", "holds codes already"),
        Refused(CUBE, "--seed 1", "holds codes already"),
        Refused(STREAM, "--seed 1", "is a stored stream"),
    ],
    ("restore", "--defects"): [
        Refused(ZIP, "--defects bad.npy", "whose layout states it"),
        Acts(CLIP, "--defects bad.npy"),
        Acts(BARE, "--defects bad.npy"),
        Acts(STREAM, "--defects bad.npy"),
        Refused(CUBE, "--defects small.npy", "the frames 16 x 24"),
        Refused(BARE, "--defects codes.npy", "a map of defective pixels is"),
    ],
    ("restore", "--width"): [
        Refused(ZIP, "--width 24", "whose layout states it"),
        Acts(CUBE, "--width 20"),
        Refused(CLIP, "--width 24", "describes a bare array"),
        Refused(STREAM, "--width 24", "is a stored stream"),
    ],
    ("restore", "--planes"): [
        Acts(CUBE, "--planes 3"),
        Acts(ZIP, "--planes 3"),
        Refused(BARE, "--planes 3", "only a clocked SPAD sums planes"),
        Refused(CLIP, "--planes 3", "holds codes of 3 bits"),
        Refused(STREAM, "--planes 3", "holds codes of 3 bits"),
    ],
    ("restore", "--from"): [
        Acts(CUBE, "--from 2"),
        Acts(STREAM, "--from 2"),
        Refused(ZIP, "--from 2", "the challenge scores the last plane"),
    ],
    ("restore", "--to"): [
        Acts(CUBE, "--to 4"),
        Refused(ZIP, "--to 4", "the challenge scores the last plane"),
        Refused(CUBE, "--to 4000", "give"),
    ],
    ("restore", "--every"): [
        Acts(CUBE, "--every 2"),
        Refused(f"{CUBE} --planes 3", "--every 2", "would share planes"),
        Refused(ZIP, "--every 4", "the challenge scores the last plane"),
    ],
    ("restore", "--frame-rate"): [
        Refused(ZIP, "--frame-rate 20", "whose layout states it"),
        Acts(CUBE.replace("spad-320x240", "spad.toml"), "--frame-rate 300"),
        Acts(BARE.replace("quiver-paper", "spad.toml"), "--frame-rate 300"),
        Refused(CLIP, "--frame-rate 20", "describes a bare array"),
        Refused(STREAM, "--frame-rate 20", "is a stored stream"),
    ],
    ("restore", "--memory"): [
        Acts(CLIP, three_frames("moment"), seen("read")),
        Refused(NET.replace("clip", "large"), "--memory 1MB", "raise --memory"),
    ],
    ("restore", "--mode"): [
        Acts(NET, "--mode exact"),
        Refused(CLIP, "--mode streaming", "acts on networks"),
        Refused(UNET, "--mode streaming", "it has one mode"),
    ],
    ("restore", "--device"): [
        Refused(NET, "--device cuda", "no CUDA device"),
        Refused(CLIP, "--device cpu", "acts on networks"),
    ],
    ("restore", "--precision"): [
        Acts(NET, "--precision bfloat16"),
        Refused(CLIP, "--precision bfloat16", "acts on networks"),
    ],
    ("restore", "--threads"): of_torch(f"{UNET} -q"),
    ("restore", "--strict"): [
        Refused(NET.replace("small", "measured").replace("--ppp 3", "--ppp 26"), "--strict", "is worse than"),
        Refused(CLIP, "--strict", "acts on networks"),
    ],
    ("restore", "--force"): [
        Acts(f"{CLIP} --seed 1", "--force", codes=(0, 2), before=CLIP),
        Acts(f"{ZIP} --planes 3", "--force", codes=(0, 2), before=ZIP),
    ],
    # evaluate
    ("evaluate", "--output"): of_clips("-o", "t", Acts(SCORE, "-o other/table", names)),
    ("evaluate", "--methods"): [
        Acts(SCORE, "--methods moment", scores),
        Acts(COUNTS, "--methods moment", static_scores),
        Refused(SCORE, "--methods momnt", "no method"),
    ],
    ("evaluate", "--split"): of_clips(
        "--split",
        "val",
        Acts("evaluate data -o table --methods naive", "--split val", scores),
        Refused(SCORE, "--split val", "is one clip"),
    ),
    ("evaluate", "--stream"): of_clips(
        "--stream",
        "p3",
        Acts(STORED, "--stream p1", scores),
        Refused(SCORE, "--stream p3", "p3"),
    ),
    ("evaluate", "--sensor"): of_clips(
        "--sensor",
        "quiver-published",
        Acts(SCORE, "--sensor quiver-published", scores),
        Refused(STORED, "--sensor quiver-paper", "is stored"),
    ),
    ("evaluate", "--ppp"): of_clips(
        "--ppp", "9", Acts(SCORE, "--ppp 3.25,9", scores), Refused(STORED, "--ppp 9", "is stored")
    ),
    ("evaluate", "--bits"): [
        Refused(f"{PLANES} --planes 3", "--bits 2", "are not clipped"),
        Acts(SCORE, "--bits 1,3", scores),
        Acts(COUNTS, "--bits 1", static_scores),
        Refused(COUNTS, "--bits 1,3", "give one number"),
        Refused(COUNTS, "--bits 9", "1 to 8 bits"),
        Refused(STORED, "--bits 1", "is stored"),
    ],
    ("evaluate", "--seed"): [
        Acts(SCORE, "--seed 1", scores),
        Acts(COUNTS, "--seed 1", static_scores),
        Refused(STORED, "--seed 1", "is stored"),
    ],
    ("evaluate", "--published"): of_clips(
        "--published",
        "",
        Acts(SCORE, "--published", scores),
        Refused(STORED, "--published", "is stored"),
        Refused("evaluate short -o table --methods naive", "--published", "too few"),
    ),
    ("evaluate", "--protocol"): of_clips(  # its effect: tests/quiver/data/test_test_sets.py
        "--protocol", "x4k1000fps", Refused(SCORE, "--protocol quiver-published", "holds no videos")
    ),
    ("evaluate", "--peak"): [Acts(SCORE, "--peak 20", scores), Acts(COUNTS, "--peak 20", static_scores)],
    ("evaluate", "--static"): [
        Acts(COUNTS, "--static more.npy", static_scores),
        Refused(SCORE, "--static counts.npy", "--static scores measured counts"),
    ],
    ("evaluate", "--frames"): [
        Acts(COUNTS, "--frames 9", static_scores),
        Refused(SCORE, "--frames 9", "belongs to --static"),
    ],
    ("evaluate", "--planes"): [
        Acts(PLANES, "--planes 3", static_scores),
        Refused(SCORE, "--planes 3", "belongs to --static"),
    ],
    ("evaluate", "--width"): [
        Acts(PLANES.replace(" --width 24", ""), "--width 24", static_scores, codes=(0, 2)),
        Refused(SCORE, "--width 24", "belongs to --static"),
    ],
    ("evaluate", "--from"): [
        Acts(PLANES, "--from 2", static_scores),
        Refused(SCORE, "--from 2", "belongs to --static"),
    ],
    ("evaluate", "--to"): [
        Acts(PLANES, "--to 18", static_scores),
        Refused(SCORE, "--to 18", "belongs to --static"),
    ],
    ("evaluate", "--every"): [
        Acts(PLANES, "--every 2", static_scores),
        Refused(SCORE, "--every 2", "belongs to --static"),
    ],
    ("evaluate", "--splits"): [
        Acts(COUNTS, "--splits 2", static_scores),
        Refused(SCORE, "--splits 2", "belongs to --static"),
    ],
    ("evaluate", "--memory"): [
        Acts(SCORE, three_frames("naive"), seen("read")),
        Acts(SCORE_NET.replace("clip", "large"), "--memory 1MB", scores, codes=(0, 1)),
    ],
    ("evaluate", "--mode"): [
        Acts(SCORE_NET, "--mode exact", scores),
        Refused(SCORE, "--mode streaming", "acts on networks"),
        Refused(SCORE_UNET, "--mode streaming", "it has one mode"),
    ],
    ("evaluate", "--device"): [
        Refused(SCORE_NET, "--device cuda", "no CUDA device"),
        Refused(SCORE, "--device cpu", "acts on networks"),
        Refused(COUNTS, "--device cpu", "acts on networks"),
    ],
    ("evaluate", "--precision"): [
        Acts(SCORE_NET, "--precision bfloat16", scores),
        Refused(SCORE, "--precision bfloat16", "acts on networks"),
    ],
    ("evaluate", "--threads"): of_torch(SCORE_UNET),
    ("evaluate", "--strict"): [
        Refused(SCORE_NET.replace("small", "measured") + " --ppp 26", "--strict", "is worse than"),
        Refused(COUNTS.replace("naive", "measured.safetensors"), "--strict", "was never measured near ideal counter"),
        Refused(SCORE, "--strict", "acts on networks"),
        Refused(COUNTS, "--strict", "acts on networks"),
    ],
    ("evaluate", "--force"): of_clips(
        "--force",
        "",
        Acts(f"{SCORE} --seed 1", "--force", scores, codes=(0, 2), before=SCORE),
        Refused(SCORE.replace("-o table", "-o clip"), "--force", "holds nothing else"),
    ),
    # domain
    ("domain", "--split"): of_measuring(
        "--split",
        "val",
        Acts(CELLS.replace("clip", "data"), "--split val", cells),
        Refused(CELLS, "--split val", "only clip folders are given"),
    ),
    ("domain", "--sensor"): of_measuring(
        "--sensor", "quiver-published", Acts(CELLS, "--sensor quiver-published", cells)
    ),
    ("domain", "--bits"): of_measuring("--bits", "1", Acts(CELLS, "--bits 1,3", cells)),
    ("domain", "--ppp"): of_measuring("--ppp", "9", Acts(CELLS, "--ppp 3.25,9", cells)),
    ("domain", "--methods"): of_measuring(
        "--methods",
        "moment",
        Acts(CELLS, "--methods moment", cells),
        Refused(CELLS, "--methods mergenet", "measured against classical methods"),
    ),
    ("domain", "--seed"): of_measuring("--seed", "1", Acts(CELLS, "--seed 1", cells)),
    ("domain", "--memory"): of_measuring(
        "--memory", "1MB", Refused(CELLS_NET.replace("clip", "large"), "--memory 1MB", "raise --memory")
    ),
    ("domain", "--mode"): of_measuring(
        "--mode",
        "streaming",
        Acts(CELLS_NET, "--mode exact", seen("score")),
        Refused(CELLS, "--mode streaming", "it has one mode"),
    ),
    ("domain", "--device"): of_measuring("--device", "cpu", Refused(CELLS, "--device cuda", "no CUDA device")),
    ("domain", "--precision"): of_measuring(
        "--precision", "bfloat16", Acts(CELLS, "--precision bfloat16", seen("score"))
    ),
    ("domain", "--threads"): of_measuring("--threads", "1", *of_torch(CELLS)),
    ("domain", "--force"): of_measuring("--force", "", Acts(CELLS, "--force", seen("cell"), before=CELLS)),
    # ablate
    ("ablate", "--output"): [Acts(ABLATE, "-o seven", names)],
    ("ablate", "--preset"): [Acts(ABLATE, "--preset quiver", tensors)],
    ("ablate", "--protocol"): [Acts(ABLATE, "--protocol spad-sum", tensors)],
    ("ablate", "--steps"): [Acts(ABLATE, "--steps 2", tensors)],
    ("ablate", "--minutes"): [Acts(f"{ABLATE} --steps 2", "--minutes 1e-7", tensors)],
    ("ablate", "--sensor"): [
        Acts(ABLATE, "--sensor quiver-published", tensors),
        Refused(f"{ABLATE} -q", "--sensor carries.toml", "training windows cannot follow"),
    ],
    ("ablate", "--ppp"): [Acts(ABLATE, "--ppp 9", tensors)],
    ("ablate", "--temperature"): [Refused(ABLATE, "--temperature 30", "temperature")],
    ("ablate", "--bits"): [Acts(ABLATE, "--bits 1", tensors)],
    ("ablate", "--crop"): [
        Acts(ABLATE, "--crop 16", tensors),
        Refused(f"{ABLATE} -q", "--crop 6", "needs a multiple of 4"),
    ],
    ("ablate", "--batch"): [Acts(ABLATE, "--batch 2", tensors)],
    ("ablate", "--split"): [Acts(ABLATE, "--split val", scores)],
    ("ablate", "--seed"): [Acts(ABLATE, "--seed 1", tensors)],
    ("ablate", "--memory"): [Acts(ABLATE.replace("data", "wide"), "--memory 1MB", scores, codes=(0, 1))],
    ("ablate", "--mode"): [Acts(ABLATE, "--mode exact", scores)],
    ("ablate", "--device"): [Refused(f"{ABLATE} -q", "--device cuda", "no CUDA device")],
    ("ablate", "--precision"): [Acts(ABLATE, "--precision bfloat16", scores)],
    ("ablate", "--threads"): of_torch(ABLATE),
    # bench
    ("bench", "--methods"): [Acts(BENCH_CLASSICAL, "--methods naive", costs)],
    ("bench", "--modes"): [
        Acts(BENCH, "--modes windows", costs),
        Refused(BENCH_CLASSICAL, "--modes exact", "acts on networks"),
        Refused(BENCH_CLASSICAL.replace("moment", "unet"), "--modes exact", "has one mode"),
    ],
    ("bench", "--precisions"): [
        Acts(BENCH_UNET, "--precisions bfloat16", costs),
        Refused(BENCH_CLASSICAL, "--precisions bfloat16", "acts on networks"),
    ],
    ("bench", "--size"): [Acts(BENCH_CLASSICAL, "--size 24x16", costs)],
    ("bench", "--ppp"): [Acts(BENCH_CLASSICAL, "--ppp 9", costs)],
    ("bench", "--device"): [
        Refused(BENCH, "--device cuda", "no CUDA device"),
        Refused(BENCH_CLASSICAL, "--device cpu", "acts on networks"),
    ],
    ("bench", "--threads"): of_torch(BENCH_CLASSICAL),
    ("bench", "--output"): [Acts(BENCH_CLASSICAL, "-o b", names)],
    ("bench", "--force"): [
        Acts(f"{BENCH_CLASSICAL} -o b --ppp 9", "--force", costs, codes=(0, 2), before=f"{BENCH_CLASSICAL} -o b"),
        Refused(BENCH_CLASSICAL, "--force", "which is not given"),
    ],
    # convert-weights
    ("convert-weights", "--output"): [Acts(CONVERT, "-o other.safetensors", names, before=their_weights)],
    ("convert-weights", "--force"): [
        Acts(CONVERT.replace("ours", "small"), "--force", tensors, codes=(0, 2), before=their_weights)
    ],
}


# ---- The program on a small scale


def tiny(name: str) -> torch.nn.Module:
    return UNet(UNetConfig(8)) if name == "unet" else QUIVER(PRESETS[name])


def few(setting: cost.CostSettings) -> cost.CostSettings:
    """Two of 12 frames, in place of 16 of 26."""
    return replace(setting, frames=12, restored=2)


@pytest.fixture(scope="module")  # of this module alone: what it replaces is back for the next one
def scale() -> Iterator[None]:
    """Small networks, one of six ablations, benches in process, no figures or CUDA; and notes of what runs did."""
    measure_cell = domain_measurement.measure_cell
    score = domain_measurement.score
    fill_classical = restorers.fill_classical
    loader = loop.DataLoader

    def one_cell(*args: Any) -> Cell:
        see("cell", args[-1])
        return measure_cell(*args)

    def one_score(*args: Any) -> float:
        found = score(*args)
        see("score", found)  # cells are rounded
        return found

    def filled(restore: Any, window: int, codes: Any, *rest: Any) -> None:
        read = codes.read

        def noted(start: int, stop: int) -> Any:
            see("read", stop - start)
            return read(start, stop)

        fill_classical(restore, window, replace(codes, read=noted), *rest)

    def loaded(windows: Any, num_workers: int, **named: Any) -> Any:
        see("workers", num_workers)
        return loader(windows, **named | {"multiprocessing_context": None})

    number = torch.get_num_threads()
    ablations = dict(ABLATIONS)
    torch.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PRESETS, "quiver-s", TINY)
        patch.setitem(PRESETS, "quiver", replace(TINY, channels=4))
        for name in set(ABLATIONS) - {"all"}:
            patch.delitem(ABLATIONS, name)
        patch.setattr(presets, "build", tiny)
        patch.setattr(figures, "_encoded", lambda figure, kind: b"a figure")  # a third of a second each
        patch.setattr(cost, "bench", lambda cases, setting, _: [cost.measure(case, few(setting)) for case in cases])
        patch.setattr(domain_measurement, "measure_cell", one_cell)
        patch.setattr(domain_measurement, "score", one_score)
        patch.setattr(restorers, "fill_classical", filled)
        patch.setattr(loop, "DataLoader", loaded)
        patch.setattr(torch.cuda, "is_available", lambda: False)
        patch.setattr(threads, "cores", lambda: 4)
        patch.setattr(torch, "set_num_threads", lambda number: see("threads", number))  # two on busy cores are slow
        yield
    ABLATIONS.clear()  # what is deleted comes back at the end, and tables follow the order
    ABLATIONS.update(ablations)
    threads.measured.cache_clear()
    torch.set_num_threads(number)


@pytest.fixture(scope="module")
def work(scale: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the rows name."""
    folder = tmp_path_factory.mktemp("work")
    rng = np.random.default_rng(0)
    size = {"frames": 12, "height": 16, "width": 24}
    write_dataset(folder / "data", {"train": 2, "val": 1, "test": 1}, **size)
    write_dataset(folder / "lone", {"train": 1}, **size)
    write_dataset(folder / "wide", {"train": 1, "val": 1, "test": 1}, frames=12, height=16, width=100)
    for name, streams in (("clip", ()), ("one", (1,)), ("two", (1, 3))):
        clip = write_clip(folder / name, **size)
        for ppp in streams:
            sense(clip, Sensing("quiver-physical", bits=3, ppp=ppp, name=f"p{ppp}"))
    write_clip(folder / "short", frames=5, height=16, width=24)
    write_clip(folder / "large", frames=11, height=88, width=88)
    np.save(folder / "codes.npy", rng.integers(0, 2, (12, 16, 24)).astype(np.uint8))
    np.save(folder / "bad.npy", rng.random((16, 24)) < 0.1)
    np.save(folder / "small.npy", np.ones((8, 8), bool))
    np.save(folder / "cube.npy", rng.integers(0, 256, (12, 16, 3)).astype(np.uint8))
    (folder / "cubes/fan").mkdir(parents=True)
    np.save(folder / "cubes/fan/000000.npy", rng.integers(0, 256, (6, 5, 2, 3)).astype(np.uint8))
    np.save(folder / "counts.npy", rng.poisson(1.0, (14, 16, 16)))
    np.save(folder / "more.npy", rng.poisson(2.0, (14, 16, 16)))
    np.save(folder / "planes.npy", np.random.default_rng(1).integers(0, 256, (24, 16, 3)).astype(np.uint8))
    (folder / "spad.toml").write_text('[sensor]\nmodel = "BinarySPAD"\nbits = 1\npde = 0.5\ndark_count_rate = 100.0\n')
    (folder / "carries.toml").write_text(
        '[sensor]\nmodel = "CountingSPAD"\nbits = 3\npde = 0.5\ndark_count_rate = 100.0\ndead_time = 2e-5\n'
        "[defects]\ncarry_dead_time = true\n"
    )
    torch.manual_seed(0)
    small = fill_by_rule(QUIVER(TINY))
    torch.nn.init.constant_(small.refine.picture[-1].bias, 0.3)  # light above 0: clamped pixels hide what options do
    save(small, TINY, folder / "small.safetensors")
    save(UNet(UNetConfig(2)), UNetConfig(2), folder / "unet.safetensors")
    seen_by = devices.load("quiver-physical", ppp=26, bits=3, exposure=5e-4)
    cell = Cell("quiver-physical", 26, domain.place_of(seen_by, 5e-4, 26), 15.0, "qbp-bm3d", 20.0)
    measured = {domain.KEY: Domain((cell,), {"clips": ["gears"], "seed": 0}).to_json()}
    save(small, TINY, folder / "measured.safetensors", measured)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert program.main(RESUMED.split()) == 0
    return folder


# ---- The tests


def test_every_option_has_a_row():
    """Read from the parsers: an option without a row fails here, and so does a row without an option."""
    assert set(ROWS) == set(options(program.PROGRAM))


def test_every_row_shows_its_option():
    for (command, option), rows in ROWS.items():
        assert rows
        for row in rows:
            assert row.option.split()[0] in names_of(program.PROGRAM, command, option), row
            assert row.command.removeprefix("only a note: ").startswith(command), row


@pytest.mark.parametrize(
    "row",
    [
        pytest.param(row, id=f"{' '.join(key)}-{i}", marks=[pytest.mark.slow] if row.slow else [])
        for key, rows in ROWS.items()
        for i, row in enumerate(rows)
    ],
)
def test_the_option_acts_or_is_refused(row, work, tmp_path, capsys, monkeypatch):
    check(row, program.main, work, tmp_path, capsys, monkeypatch, named=True)
