"""Every option of `quiver` acts or is refused, in every situation below (support/acting.py).

A new option needs nothing here, unless no situation lets it act.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import spad_camera
import torch
from acting import Bench, Commands, Run, Situation, check_json, check_printing, exit_code, names, stdout
from clips import write_clip, write_dataset
from golden import TINY, fill_by_rule, published_state
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


SEEN: dict[Path, dict[str, list[Any]]] = {}


def see(what: str, value: Any) -> None:
    SEEN.setdefault(Path.cwd(), {}).setdefault(what, []).append(value)


def seen(what: str) -> Callable[[Run], list[Any]]:
    """Return what the program did in a folder: torch's threads, frames per read, worker processes, cells measured."""
    return lambda run: SEEN[run.folder.resolve()].get(what, [])


def described(run: Run) -> dict[str, bytes]:
    """All files with their descriptions, where what is stated is the effect."""
    return {path.name: path.read_bytes() for path in run.folder.rglob("*.json")}


# ---- Situations

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
    """The value of --memory with what a classical method needs for blocks of three frames of 16 x 24."""
    return f"{16 * 24 * (METHODS[method].bytes_per_pixel + 3 * restorers.FRAME_BYTES)}"


def needs(line: str, *only: str, **words: str) -> Situation:
    """A line that fails without each of these settings."""
    return Situation(line, exit_code, words, codes=(0, 2), only=only)


def replaces(line: str, before: str | Callable[[Path], None] = "") -> Situation:
    """A line whose result stands there already, made by another line."""
    return Situation(line, exit_code, before=before, codes=(0, 2), only=("force",))


SITUATIONS = (
    # train
    Situation(TRAIN, tensors),
    Situation(TRAIN, history, only=("validate_every", "validation_split")),
    Situation(TRAIN, tensors, only=("minutes", "network", "protocol", "steps", "crop", "batch")),
    Situation(TRAIN.replace("--batch 1", "--batch 2"), tensors, {"accumulate": "2"}, only=("accumulate",)),
    Situation(TRAIN.replace("unet --protocol control", "quiver-s-1m"), tensors, only=("pretraining",)),
    Situation(TRAIN, names, only=("out",)),
    Situation(CLIP, only=("method", "ppp")),
    Situation(CLIP, names, only=("output",)),
    Situation(TRAIN.replace("--steps 2", "--minutes 1e-7"), history, only=("validate_every",)),
    Situation(f"{TRAIN} --sensor warm.toml --ppp 3", tensors, only=("temperature",)),
    Situation(TRAIN.replace("data", "lasting"), tensors, {"planes": "2"}, only=("planes",)),
    Situation(RESUMED, tensors),
    Situation(f"{TRAIN} --sensor spad.toml --ppp 3", tensors, {"bits": "2"}),
    replaces(f"{RESUMED} --seed 1"),
    # restore
    Situation(CLIP),
    Situation(STREAM),
    needs("restore two -o r.npy --method moment", "stream"),
    Situation("restore one -o r.npy --method moment", words={"stream": "p3"}),
    Situation(BARE),
    Situation(GAIN),
    Situation(BARE.replace("quiver-paper", "spad.toml"), words={"bits": "2"}),
    Situation(CUBE, words={"bits": "2"}),
    needs(CUBE.replace("--width 24 ", ""), "width", width="24"),
    Situation("restore hot.npy --sensor spad-320x240 --bits 3 -o r.npy --method moment", only=("scan",)),
    Situation(ZIP),
    Situation(NET),
    Situation(NET.replace("--mode streaming ", ""), words={"mode": "streaming"}, only=("mode",)),
    Situation(UNET),
    Situation(
        NET.replace("small", "measured").replace("--ppp 3", "--ppp 26"), exit_code, codes=(0, 2), only=("strict",)
    ),
    replaces(f"{CLIP} --seed 1", CLIP),
    # evaluate
    Situation(SCORE, scores),
    Situation("evaluate data -o table --methods naive", scores),
    Situation(STORED, scores),
    Situation(STORED.replace(" --stream p3", ""), scores, only=("stream",)),
    Situation(COUNTS, static_scores),
    Situation(COUNTS.replace(" --splits 1", ""), static_scores, only=("splits",)),
    needs(SCORE.replace(" -o table", ""), "output"),
    Situation(SCORE, scores, only=("methods",)),
    Situation(COUNTS, static_scores, only=("methods",)),
    Situation(PLANES, static_scores, {"start": "2", "stop": "18", "every": "2"}),
    Situation(
        PLANES.replace("planes.npy --width 24", "codes.npy"), static_scores, {"summed": "7"}, only=("summed", "planes")
    ),
    Situation(PLANES.replace(" --width 24", ""), static_scores, {"width": "24"}, only=("width",)),
    Situation(SCORE_NET, scores),
    Situation(SCORE_NET.replace(" --mode streaming", ""), scores, {"mode": "streaming"}, only=("mode",)),
    Situation(SCORE_UNET, scores),
    Situation("evaluate --methods naive --splits 1 --json", exit_code, codes=(0, 2), only=("static",)),
    Situation(f"{SCORE_NET.replace('small', 'measured')} --ppp 26", exit_code, codes=(0, 2), only=("strict",)),
    replaces(f"{SCORE} --seed 1", SCORE),
    # domain
    Situation(SHOW, stdout),
    Situation(CELLS, cells),
    Situation(CELLS.replace("clip", "data"), cells),
    Situation(CELLS_NET, seen("score")),
    Situation(CELLS_NET.replace(" --mode streaming", ""), seen("score"), {"mode": "streaming"}, only=("mode",)),
    Situation(CELLS, cells, only=("methods",)),
    Situation(CELLS, seen("cell"), before=CELLS, only=("force",)),
    Situation(
        CELLS,
        seen("score"),
        {"classical_of": "small.safetensors"},
        before=CELLS.replace("unet", "small"),
        only=("classical_of",),
    ),
    # ablate, bench, convert-weights
    Situation(ABLATE, lambda run: (tensors(run), scores(run))),
    Situation(ABLATE.replace("--steps 1", "--steps 2"), tensors, only=("minutes", "steps", "crop", "batch")),
    Situation(ABLATE, names, only=("output",)),
    Situation(BENCH_CLASSICAL, costs, {"methods": "naive"}, only=("methods", "size")),
    Situation(ABLATE.replace(" --mode streaming", ""), scores, {"mode": "streaming"}, only=("mode",)),
    Situation(f"{ABLATE} --sensor warm.toml --ppp 3", tensors, only=("temperature",)),
    Situation(ABLATE.replace("data", "lasting"), tensors, {"planes": "2"}, only=("planes",)),
    Situation(BENCH, costs, only=("device",)),
    Situation(BENCH.replace(" --modes streaming", ""), costs, only=("modes",)),
    Situation(BENCH_UNET, costs),
    Situation(BENCH_CLASSICAL, costs),
    replaces(f"{BENCH_CLASSICAL} -o b --ppp 9", f"{BENCH_CLASSICAL} -o b"),
    Situation(CONVERT, names, before=their_weights, only=("output",)),
    Situation(CONVERT, tensors, before=their_weights),
    replaces(CONVERT.replace("ours", "small"), their_weights),
)

COMPUTING = ("train", "restore", "evaluate", "domain", "ablate", "bench")
COMMANDS = Commands(
    program.PROGRAM,
    program.main,
    SITUATIONS,
    words={
        "bits": "1",
        "classical_of": "small.safetensors",
        "defects": "bad.npy",
        "device": "cuda",
        "domain.ppp": "9",
        "evaluate.output": "other",
        "frame_rate": "300",
        "learning_rate": "0.03",
        "loss": "paper",
        "memory": three_frames("moment"),
        "method": "naive",
        "methods": "moment",
        "minutes": "1e-7",
        "modes": "windows",
        "output": "other",
        "convert-weights.output": "other.safetensors",
        "peak": "20",
        "planes": "3",
        "ppp": "9",
        "preset": "quiver",
        "pretraining": "0.5",
        "network": "quiver-s",
        "out": "other",
        "batch": "2",
        "crop": "12",
        "steps": "3",
        "protocol": "spad-sum",
        "restore.output": "s.npy",
        "restore.scan": "--no-scan",
        "train.scan": "--no-scan",
        "sensor": "quiver-published",
        "size": "24x16",
        "split": "val",
        "train.start": "trained",
        "start": "2",
        "static": "counts.npy",
        "stream": "p1",
        "temperature": "30",
        "threads": "2",
        "validate_every": "1",
        "validation_split": "test",
        "width": "20",
    },
    results={
        "threads": seen("threads"),
        "output": names,
        "accumulate": described,
        "compile": described,
        "windows": described,
        "restore.frame_rate": described,
        "memory": seen("read"),
        "workers": seen("workers"),
    },
    may_be_silent=frozenset({"scan", "threads", "force", "memory", "workers", "windows", "strict"}),
    prepared=frozenset({"validate_every", "validation_split", "minutes"}),
    never_here={
        **{f"{command}.device": "no other device is here" for command in COMPUTING},
        "domain.memory": "its streams are short",
        "train.scan": "its presets learn from data sets; tests/quiver/data/test_hot_pixels.py",
        "ablate.memory": "its clips are small",
        "evaluate.protocol": "its data sets are large; tests/quiver/data/test_test_sets.py",
    },
)


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
        see("cell", args[3])
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
        return loader(windows, **named | {"multiprocessing_context": None, "prefetch_factor": None})

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
    write_dataset(folder / "lasting", {"train": 1, "val": 1, "test": 1}, frames=22, height=16, width=24)
    for name, streams in (("clip", ()), ("one", (1,)), ("two", (1, 3))):
        clip = write_clip(folder / name, **size)
        for ppp in streams:
            sense(clip, Sensing("quiver-physical", bits=3, ppp=ppp, name=f"p{ppp}"))
    write_clip(folder / "short", frames=5, height=16, width=24)
    write_clip(folder / "large", frames=11, height=88, width=88)
    np.save(folder / "codes.npy", rng.integers(0, 2, (12, 16, 24)).astype(np.uint8))
    moved = spad_camera.panned(spad_camera.texture(96, 5), (48, 48), 0.5)
    taken = spad_camera.Camera(spad_camera.hot_map((48, 48), 0.02, 1)[1]).codes(moved, 4.0, 64, 7, 3)
    np.save(folder / "hot.npy", taken)
    np.save(folder / "planes.npy", rng.integers(0, 256, (24, 16, 3)).astype(np.uint8))
    np.save(folder / "bad.npy", rng.random((16, 24)) < 0.1)
    np.save(folder / "small.npy", np.ones((8, 8), bool))
    np.save(folder / "cube.npy", rng.integers(0, 256, (12, 16, 3)).astype(np.uint8))
    (folder / "cubes/fan").mkdir(parents=True)
    np.save(folder / "cubes/fan/000000.npy", rng.integers(0, 256, (6, 5, 2, 3)).astype(np.uint8))
    np.save(folder / "counts.npy", rng.poisson(1.0, (14, 16, 16)))
    np.save(folder / "more.npy", rng.poisson(2.0, (14, 16, 16)))
    (folder / "spad.toml").write_text('[sensor]\nmodel = "BinarySPAD"\nbits = 1\npde = 0.5\ndark_count_rate = 100.0\n')
    (folder / "warm.toml").write_text(
        '[sensor]\nmodel = "BinarySPAD"\nbits = 1\npde = 0.5\ndark_count_rate = 100.0\n'
        "dark_doubling = 8.0\ndark_reference = 20.0\n"
    )
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


FIRST = {one.command: one.line for one in reversed(SITUATIONS)} | {"completion": "completion bash"}


@pytest.mark.parametrize("command", COMMANDS.program.commands)
def test_a_command_is_quiet_or_verbose(command, tmp_path, capsys, monkeypatch):
    check_printing(COMMANDS, FIRST[command].replace(" --json", ""), tmp_path, capsys, monkeypatch)


@pytest.mark.parametrize("command", COMMANDS.program.commands)
def test_a_command_prints_an_object_for_programs(command, work, tmp_path, capsys, monkeypatch):
    check_json(COMMANDS, FIRST[command].replace(" --json", ""), work, tmp_path, capsys, monkeypatch)


@pytest.mark.parametrize(("setting", "situations", "everywhere"), list(COMMANDS.cases()))
def test_a_setting_acts_or_is_refused(setting, situations, everywhere, work, tmp_path, capsys, monkeypatch):
    Bench(COMMANDS, work, tmp_path, capsys, monkeypatch).check(setting, situations, everywhere)
