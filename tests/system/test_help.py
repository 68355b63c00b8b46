"""Tests of `--help`: the commonest options come first; examples are read as they stand, and run."""

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile
from clips import packed, write_clip

import qsim.cli.program
import quiver.cli.program
from qsim.cli.usage import Program
from qsim.dataset.generation import Options, generate
from qsim.dataset.job import Job
from qsim.dataset.recipe import Recipe
from qsim.formats.video import write_video
from qsim.keys import Key
from qsim.rendering.render_settings import RenderSettings
from qsim.sensor.counting import CountingSPAD
from qsim.streams.clip import Clip

PROGRAMS = (qsim.cli.program.PROGRAM, quiver.cli.program.PROGRAM)
COMMANDS = [(program, name) for program in PROGRAMS for name in program.commands]


def words_of(example: str) -> list[str]:
    """Return the words of an example behind the name of its program, without comments and redirections."""
    words = shlex.split(example, comments=True)
    words = words[: next((i for i, word in enumerate(words) if word.startswith(">")), len(words))]
    return words[next(i for i, word in enumerate(words) if word in ("qsim", "quiver")) + 1 :]


def options_in(help_: str) -> list[list[str]]:
    """Return the spellings of each option below the heading `options:`, in order, but those that every command has."""
    (section,) = re.findall(r"^options:\n((?:  .*\n)+)", f"{help_}\n", re.MULTILINE)
    rows = [re.split(r"  +", line.strip())[0] for line in section.splitlines() if line.startswith("  -")]
    found = [re.findall(r"(?<!\S)--?[a-z][a-z-]*", row) for row in rows]
    return [names for names in found if not {"--help", "--json", "--quiet", "--verbose"} & set(names)]


@pytest.mark.parametrize(("program", "name"), COMMANDS, ids=lambda value: getattr(value, "name", value))
def test_options_of_more_examples_come_first(program: Program, name: str):
    examples = [words_of(example) for example in program.declared(name).examples]
    uses = [sum(bool(set(names) & set(words)) for words in examples) for names in options_in(program.help(name))]
    assert uses == sorted(uses, reverse=True)


def test_the_commonest_options_of_some_commands():
    first = {name: [names[-1] for names in options_in(program.help(name))][:3] for program, name in COMMANDS}
    assert first["train"] == ["--output", "--minutes", "--preset"]
    assert first["sense"] == ["--bits", "--ppp", "--sensor"]
    assert first["restore"] == ["--output", "--method", "--ppp"]


@pytest.mark.parametrize(("program", "name"), COMMANDS, ids=lambda value: getattr(value, "name", value))
def test_examples_are_read(program: Program, name: str):
    for example in program.declared(name).examples:
        found, values = program.read(words_of(example))
        assert found is program.declared(name)
        found.arguments(values)


# Examples that run

ELSEWHERE = {  # what renders, trains for minutes, or needs foreign files: run by a page or a test, with other sizes
    "qsim render": "README.md",
    "qsim generate": "docs/datasets.md",
    "qsim plan": "docs/datasets.md",
    "qsim tradeoff": "docs/tradeoff.md",
    "qsim validate": "tests/qsim/studies/validation",
    "qsim demo": "tests/qsim/cli/test_demo.py",
    "qsim publish out/starter -o s3": "tests/qsim/publishing/test_storage.py",
    "qsim convert out/challenge": "tests/system/test_challenge.py",
    "qsim convert out/room": "tests/qsim/formats",
    "quiver domain": "docs/training.md",
    "quiver ablate": "tests/quiver/cli/test_program.py",
    "quiver bench": "docs/training.md",
    "quiver convert-weights": "tests/quiver/cli/test_program.py",
    "quiver restore out/cubes": "tests/system/test_challenge.py",
    "quiver evaluate I2": "tests/quiver/data/test_test_sets.py",
    "torchrun": "tests/quiver/training",
}
OTHER_WORDS = {  # of the examples -> of this test: quick methods, few steps, the parts that a small set has
    "--minutes 20": "--steps 1 --batch 1 --crop 16",
    "moment,mergenet": "naive,moment",
    "naive,moment,out/mine,out/unet": "naive,moment",
    "--method out/mine": "--method naive",
    "7/100": "1/2",
    "/data/mine": "out/starter",
    "/data/published": "out/published",
    "out/starter/clips/fan_0003 -o out/fan.npy": "out/starter/clips/fan_0003 -o out/fan_3.npy --method naive",
    "--from 1000 --until 8000": "--from 10 --until 80",
    "--from 1000": "--from 10",
    "hazelnut_gates6_TKYX_uint8.npy": "counts.npy",
    "out/fan.npy --method": "out/restored.npy --method",
    "quiver restore cube.npy": "quiver restore cube.npy --method naive",
    "--rate 2000": "--rate 60",
    "out/capture --layout": "out/capture_raw --layout",
}


def write_world(folder: Path) -> None:
    """Write what the examples name: clips, a data set, streams, restored video and recordings."""
    rng = np.random.default_rng(0)
    settings = RenderSettings(frames=14, height=32, width=40, frame_rate=2000.0)
    scenes = [("fan", 3, "train"), ("fan", 1, "val"), ("gears", 0, "test")]
    jobs = tuple(Job(family, seed, 1.0, split, settings, 0, ()) for family, seed, split in scenes)

    def make(job: Job, target: Path) -> object:
        return write_clip(target, height=32, width=40, seed=job.scene_seed, job=job.digest)

    generate(Recipe("starter", jobs), folder / "out/starter", Options(workers=0), make=make)
    small = {"frames": 14, "height": 32, "width": 40, "flow": np.ones((2, 32, 40), np.float32)}
    clips = [
        write_clip(folder / "out" / name, **small) for name in ("fan", "planes", "readouts/clips/fan_0000", "demo")
    ]
    for clip in [*clips, *(Clip.open(path) for path in (folder / "out/starter/clips").iterdir())]:
        clip.sense("quiver-physical", bits=3, ppp=3.25)
    clips[0].sense("spad-320x240", ppp=3.25, bits=1, name="spad")
    clips[0].sense_events("dvs", ppp=100)
    clips[0].sense("quiver-paper", ppp=3.25, bits=3, name="spike")
    clips[0].sense("quiver-paper", ppp=9.0, bits=3, name="conventional")
    main("quiver", "restore out/fan --stream quiver-physical_3bit_3.25ppp -o out/fan.npy --method moment", folder)
    for suffix in (".npy", ".json"):
        shutil.copy(folder / f"out/fan{suffix}", folder / f"out/fan_restored{suffix}")
    np.save(folder / "ball.npy", rng.integers(0, 60000, (4, 32, 40)).astype(np.uint16))
    frames = rng.integers(0, 4000, (3, 32, 40)).astype(np.uint16)
    tifffile.imwrite(folder / "camera.tif", frames, photometric="minisblack")
    (folder / "I2-2000FPS/test").mkdir(parents=True)
    grey = rng.integers(0, 255, (4, 32, 40)).astype(np.uint8)
    for path in ("phone.mp4", "I2-2000FPS/test/a.mp4"):
        write_video(folder / path, iter(grey), 30.0, lossless=True)
    (folder / "capture.bin").write_bytes(rng.integers(0, 255, 2 * 256 * 512 // 8, dtype=np.uint8).tobytes())
    planes = rng.random((140, 32, 320)) < 0.2
    packed(planes, folder / "cube.npy")
    packed(rng.random((140, 32, 512)) < 0.2, folder / "still.npy")
    packed(planes[:, :, :40], folder / "packed.npy")
    main("qsim", "convert packed.npy out/capture --layout cube --width 40 --frame-rate 10000", folder)
    still = np.repeat(np.linspace(5.0, 120.0, 20), 64).reshape(32, 40)  # enough pixels of each light for a dead time
    counter = CountingSPAD(0.4, 20.0, 1e-7, 8)
    counts = counter.sample(np.broadcast_to(still, (60, 32, 40)), 6.33e-6, key=Key(seed=0, clip=0))
    np.save(folder / "counts.npy", counts)

    def flat(light: float, exposure: float) -> np.ndarray:
        electrons = rng.poisson(light + 20 * exposure, (20, 24, 24)) + 0.25 * rng.standard_normal((20, 24, 24))
        return np.clip(np.rint(8 * electrons + 40), 0, 255).astype(np.uint8)

    for name, light, exposure in (("d1", 0, 1e-3), ("d2", 0, 0.1), ("f", 1, 1e-3), ("g", 4, 1e-3)):
        np.save(folder / f"{name}.npy", flat(light, exposure))
    np.save(folder / "dark.npy", (rng.random((200, 24, 24)) < 0.01).astype(np.uint8))
    np.save(folder / "flat.npy", (rng.random((200, 24, 24)) < 0.3).astype(np.uint8))


def main(program: str, line: str, folder: Path) -> None:
    """Run a command in a folder; fail with its messages if it does."""
    done = subprocess.run(
        [sys.executable, "-m", program, *shlex.split(line)], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{program} {line}\n{done.stdout[-500:]}\n{done.stderr[-1500:]}"


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("world")
    write_world(folder)
    return folder


def run_here() -> list[str]:
    """Return the examples that this test runs."""
    lines = [line for program, name in COMMANDS for line in program.declared(name).examples]
    return [line for line in lines if not line.startswith(tuple(ELSEWHERE)) and "completion" not in line]


def test_what_runs_elsewhere_is_there():
    root = Path(__file__).parents[2]
    lines = [line for program, name in COMMANDS for line in program.declared(name).examples]
    for start, place in ELSEWHERE.items():
        assert any(line.startswith(start) for line in lines), start
        assert (root / place).exists(), place


@pytest.mark.slow
@pytest.mark.parametrize("line", run_here())
def test_examples_run(line: str, world: Path, tmp_path: Path):
    folder = tmp_path / "world"
    shutil.copytree(world, folder)
    for old, new in OTHER_WORDS.items():
        line = line.replace(old, new)
    program = line.split()[0]
    main(program, shlex.join(words_of(line)), folder)
