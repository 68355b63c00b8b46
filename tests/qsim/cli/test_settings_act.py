"""Every option of `qsim` acts or is refused, in every situation below (support/acting.py).

A new option needs nothing here, unless no situation lets it act.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from acting import (
    Bench,
    Commands,
    Run,
    Situation,
    check_json,
    check_printing,
    exit_code,
    names,
    stdout,
    threads,
)
from clips import colour_clip, write_clip, write_dataset
from fakes import write_records

import qsim.cli.program
from qsim.cli import look
from qsim.cli.program import main
from qsim.cli.validate import ACTING
from qsim.optics.camera import Camera
from qsim.scene.camera_path import write_camera_path

RENDER = "render fan --frames 2 --height 16 --width 24 --psnr 20"
STILL = "render still.py --frames 2 --height 16 --width 24 --psnr 20 -o r"
CODES = "convert codes.npy c --layout codes --bits 3 --frame-rate 9"
LIGHT = "convert light.npy c --transfer linear --frame-rate 9"
CUBE = "convert cube.npy c --layout cube --frame-rate 9"
SPAD = "calibrate --model spad --bits 1 --dark planes.npy 1e-5 --flat lit.npy 1e-5 -o s.toml"
SUMS = "calibrate --model spad --summed 50 --dark sums.npy 1e-5 -o s.toml"
QIS = "calibrate --bits 3 --dark q0.npy 1e-3 --dark q1.npy 0.2 --flat q2.npy 1e-3 --flat q3.npy 1e-3 -o s.toml"
STATIC = "calibrate --bits 8 --static counts.npy 1e-5 -o s.toml"
RAW = "calibrate --model spad --dark dark.bin 1e-5 --bits 1 --layout raw --order msb --height 6 --width 8 -o s.toml"
STUDY = "tradeoff fast --ppp 3 --bits 1,2"
GENERATE = "generate t.toml -o d --workers 0"


def fail_once(folder: Path) -> None:
    """A data set whose only job has failed, for a reason that is gone now."""
    assert main(["generate", "broken.toml", "-o", "d", "--workers", "0", "-q"]) == 1
    (folder / "ready").mkdir()


def calibrated(run: Run) -> str:
    """What a calibration prints and the values of its file."""
    return stdout(run) + "".join(path.read_text() for path in run.folder.glob("s.toml"))


def described(run: Run) -> dict[str, bytes]:
    """All files, with their descriptions, where what is stated is the effect."""
    return {path.name: path.read_bytes() for path in run.folder.rglob("*.json")}


def damage(folder: Path) -> None:
    """A data set of which one file of light is gone."""
    assert main(["generate", "t.toml", "-o", "d", "--workers", "0", "-q"]) == 0
    next(folder.glob("d/clips/*/radiance/*.exr")).unlink()


def two_clips(folder: Path) -> None:
    """A data set."""
    write_dataset(folder / "set", {"train": 2})


def needs(line: str, *only: str, before: str = "", **words: str) -> Situation:
    """A line that fails without each of these settings."""
    return Situation(line, exit_code, words, before=before, codes=(0, 2), only=only)


def replaces(line: str, before: str, slow: bool = False) -> Situation:
    """A line whose result stands there already, made by another line."""
    return Situation(line, exit_code, before=before, codes=(0, 2), only=("force",), slow=slow)


OWN = {name for acting in ACTING.values() for name in acting}  # settings of single measurements


SITUATIONS = (
    Situation("doctor", stdout),
    Situation("recipes", stdout),
    Situation("recipes --print demo", stdout),
    Situation("sensors", stdout),
    # render
    Situation(f"{RENDER} -o r", slow=True),
    Situation(f"{RENDER} -o r", only=("frames", "height", "width", "psnr"), slow=True),
    Situation(STILL, slow=True),
    Situation(f"{RENDER} --explain", stdout, slow=True),
    replaces(f"{RENDER} -o clip", "", slow=True),
    # sense
    Situation("sense clip"),
    Situation("sense clip --name n --ppp 3 --bits 3"),
    Situation("sense clip --sensor spad-320x240 --bits 2 --ppp 3"),
    Situation("sense clip --sensor counter.toml --ppp 3"),
    Situation("sense clip --sensor spad-320x240 --ppp 3"),
    Situation("sense clip --sensor my.toml --lux 1"),
    Situation("sense clip --sensor warm.toml --ppp 0.5", only=("temperature",)),
    Situation("sense clip --ppp 3 --row-delay 1e-6"),
    Situation("sense relative --ppp 3"),
    needs("sense relative --lux 1", "pixel_pitch"),
    Situation("sense coloured --colour rggb"),
    needs("sense coloured", "colour"),
    Situation("sense clip --name s --replay clip:1", stdout),
    Situation("sense clip --ppp 3.25 --bits 3", stdout, before="sense clip --ppp 3.25 --bits 3", only=("replay",)),
    replaces("sense clip --name s --seed 9", ""),
    Situation("sense wide", only=("threads",)),
    # events
    Situation("events clip"),
    needs("events relative --lux 1", "pixel_pitch"),
    replaces("events clip --ppp 300 --name n --seed 9", "events clip --ppp 300 --name n"),
    # generate, plan, check
    Situation(GENERATE, slow=True),
    Situation(GENERATE, names, only=("output",), slow=True),
    Situation("generate t.toml -o d --cluster tcp://127.0.0.1:1", only=("workers", "memory", "threads")),
    Situation(
        "generate broken.toml -o d --workers 0", exit_code, before=fail_once, codes=(0, 1), only=("retry",), slow=True
    ),
    Situation(GENERATE, names, before=damage, codes=(0, 1), only=("repair",), slow=True),
    Situation("plan t.toml", stdout, slow=True),
    Situation("check clip", stdout),
    Situation("check rest", stdout, codes=(1,), only=("shard",)),
    # publish
    Situation("publish set -o e", before=two_clips, only=("shard_size",)),
    Situation("publish clip -o e"),
    Situation("publish clip -o e --sensor spad-320x240 --bits 2 --ppp 3 --fields codes"),
    Situation("publish clip -o e --sensor counter.toml --ppp 3 --fields codes,truth"),
    Situation("publish clip -o e --sensor my.toml --lux 1 --fields codes"),
    Situation("publish clip -o e --sensor warm.toml --ppp 0.5", only=("temperature",)),
    Situation("publish clip -o e --ppp 3 --row-delay 1e-6 --fields codes"),
    needs("publish relative -o e --lux 1", "pixel_pitch"),
    needs("publish coloured -o e --sensor quiver-physical", "colour"),
    Situation("publish clip -o e", names, only=("output",)),
    replaces("publish clip -o e --packed", "publish clip -o e"),
    # compare, preview, report, explore
    Situation("compare clip", stdout),
    Situation("preview clip", stdout),
    Situation("preview clip --what codes", stdout),
    Situation("preview clip --what sharp", stdout),
    Situation("preview relative", stdout, only=("what", "bits", "width", "stream")),
    Situation("preview values.npy", stdout),
    Situation("preview codes.npy --bits 3", stdout),
    Situation("preview cube.npy --width 16", stdout),
    Situation("preview planes.npy --bits 1", stdout, {"planes": "4", "start": "9", "stop": "9", "every": "9"}),
    needs("preview codes.npy", "bits"),
    needs("preview codes.npy", "summed", summed="6"),
    needs("preview cube.npy", "width", width="13"),
    Situation("preview clip/streams/s.json", stdout),
    Situation("preview clip -o p.gif"),
    Situation("preview clip -o p.png --frame 0"),
    replaces("preview clip -o p.png --frame 1", "preview clip -o p.png --frame 0"),
    Situation("preview clip --play", stdout),
    Situation("report clip"),
    replaces("report clip --title B", "report clip --title A"),
    Situation("explore clip"),
    replaces("explore clip -o x.html", "report clip -o x.html"),
    # convert
    Situation(CODES),
    Situation(CUBE, words={"width": "13"}),
    Situation(LIGHT),
    Situation(LIGHT, names, {"white": "30000"}, only=("white",)),
    Situation("convert spikes.dat c --layout spike --height 16 --width 8 --frame-rate 9"),
    Situation("convert stretched c --bits 2 --frame-rate 9 --stretched"),
    Situation("convert colour.npy c --layout cube --frame-rate 9 --channel 0", words={"width": "13"}),
    needs("convert codes.npy c --layout codes --frame-rate 9", "bits"),
    needs("convert codes.npy c --layout codes --bits 3", "frame_rate"),
    Situation(CODES, stdout, {"summed": "6"}, only=("summed",)),
    needs("convert cube.npy c --frame-rate 9", "layout", layout="codes"),
    needs("convert spikes.dat c --layout spike --width 8 --frame-rate 9", "height", height="16"),
    needs("convert stretched c --bits 2 --frame-rate 9", "stretched"),
    needs("convert colour.npy c --layout cube --frame-rate 9", "channel"),
    needs("convert two.mat c --bits 5 --frame-rate 9", "variable"),
    needs(f"{CODES} --sensor quiver-physical", "ppp"),
    Situation(
        "convert raw.bin c --layout raw --height 16 --width 24 --bits 8 --frame-rate 9", words={"skip_bytes": "384"}
    ),
    Situation("convert stack.tif c --layout tiff --axes TCYX --channel 0 --transfer linear --frame-rate 9"),
    Situation("convert stack.tif c --layout tiff --axes TZYX --slice 0 --transfer linear --frame-rate 9"),
    needs("convert raw.bin c --layout raw --height 16 --width 24 --bits 1 --frame-rate 9", "order"),
    needs("convert words.bin c --layout raw --height 16 --width 24 --bits 16 --frame-rate 9", "endian"),
    needs("convert stack.tif c --layout tiff --axes TCYX --transfer linear --frame-rate 9", "channel"),
    needs("convert stack.tif c --layout tiff --axes TZYX --transfer linear --frame-rate 9", "slice"),
    needs("convert two.h5 c --transfer linear --frame-rate 9", "dataset"),
    Situation("convert gaps c --transfer linear --frame-rate 9"),
    needs("convert clip e", "to"),
    needs("convert bands e --to challenge", "window"),
    replaces(f"{CODES} --flip ud", CODES),
    Situation("convert clip e.h5", stdout),
    Situation("convert clip e.mp4"),
    Situation("convert clip e.mp4", names, only=("to",)),
    Situation("convert clip e --to png"),
    Situation("convert clip e --to exr"),
    Situation("convert clip/streams/s.json e --to png"),
    # tradeoff
    Situation("tradeoff --table", stdout),
    Situation(STUDY, stdout),
    Situation(f"{STUDY} --speed 2", stdout),
    Situation(f"{STUDY} -o st", stdout),
    Situation(f"{STUDY} --sensor warm.toml", stdout, only=("temperature",)),
    Situation("tradeoff fast --bits 1,2", stdout, only=("ppp",)),
    Situation("tradeoff fan --size 16x24 --ppp 3 --bits 1,2 -o st", stdout, only=("px", "frames"), slow=True),
    needs("tradeoff", "table"),
    replaces(f"{STUDY} -o st", f"{STUDY} -o st --seed 3"),
    Situation("tradeoff wide --ppp 3 --bits 1,2", stdout, only=("threads",)),
    # calibrate
    Situation(QIS, calibrated),
    Situation(QIS, names, only=("output",)),
    Situation(SPAD, calibrated, {"flat": "lit.npy 1e-5 0.8"}),
    Situation(SUMS, calibrated),
    Situation(STATIC, calibrated, {"model": "qis"}),
    Situation(RAW, calibrated, {"skip_bytes": "6"}),
    Situation(
        SPAD.replace("planes.npy 1e-5 --flat lit.npy 1e-5", "q0.npy 1e-3").replace("--bits 1", "--bits 3"),
        calibrated,
        {"flat": "q2.npy 1e-3"},
    ),
    needs(QIS.replace("--bits 3 ", ""), "bits", bits="3"),
    needs(RAW.replace("--layout raw ", ""), "layout"),
    needs(RAW.replace("--height 6 ", ""), "height", height="6"),
    needs(RAW.replace("--width 8 ", ""), "width", width="8"),
    needs(
        "calibrate --bits 12 --static deep.bin 1e-5 --layout raw --height 16 --width 16 -o s.toml",
        "endian",
        endian="little",
    ),
    needs("calibrate --bits 8 -o s.toml", "static"),
    needs("calibrate --model spad --dark sums.npy 1e-5 -o s.toml", "summed", summed="50"),
    Situation("calibrate --model spad --bits 1 --flat lit.npy 1e-5 -o s.toml", calibrated, only=("dark",)),
    Situation("calibrate --model spad --bits 1 --dark planes.npy 1e-5 -o s.toml", calibrated, only=("flat",)),
    needs(RAW.replace(" --order msb", ""), "order"),
    Situation(STATIC.replace("counts.npy", "turned.npy"), calibrated, {"axes": "YXT"}, only=("axes",)),
    needs(STATIC.replace("counts.npy 1e-5", "stack.tif 1e-5 --axes TCYX"), "channel"),
    needs(STATIC.replace("counts.npy 1e-5", "stack.tif 1e-5 --axes TZYX"), "slice"),
    needs(STATIC.replace("counts.npy", "two.mat"), "variable"),
    needs(STATIC.replace("counts.npy", "two.h5"), "dataset"),
    replaces(SUMS, SUMS),
    # validate
    Situation("validate reading", stdout, codes=(0, 1), slow=True),
    *(Situation(f"validate {what}", stdout, only=tuple(OWN - set(ACTING[what]))) for what in ACTING),
    Situation(
        "validate light --scenes fan --height 16 --width 24 --psnr 25",
        stdout,
        codes=(0, 1),
        only=("scenes", "height", "width", "psnr", "threads"),
        slow=True,
    ),
)

COMMANDS = Commands(
    qsim.cli.program.PROGRAM,
    main,
    SITUATIONS,
    words={
        "axes": "HTW",
        "bands": "rgb",
        "bits": "2",
        "calibrate.dark": "planes.npy 1e-5",
        "calibrate.output": "other.toml",
        "camera_path": "path.json",
        "cluster": "nowhere",
        "colour": "rggb",
        "dataset": "b",
        "defects": "bad.toml",
        "events.camera": "dvs-ideal",
        "explore.output": "other.html",
        "frame": "0",
        "frames": "3",
        "height": "12",
        "psnr": "34",
        "pixels": "2048",
        "flat": "lit.npy 1e-5 0.8",
        "layout": "raw",
        "memory": "2GB",
        "motion": "3",
        "name": "n2",
        "note": "Mine",
        "output": "other",
        "pixel_pitch": "1.1e-6",
        "convert.stop": "1",
        "exposure": "0.001",
        "exposures": "1,0.25",
        "what": "average",
        "plane_sensor": "spad-320x240",
        "preview.output": "other.png",
        "print": "demo",
        "publish.fields": "radiance",
        "publish.licence": "MIT",
        "publish.to": "hdf5",
        "publish.shard": "2/2",
        "publish.shard_size": "1e-6",
        "px": "3",
        "rate": "18",
        "replay": "clip:2",
        "report.output": "other.html",
        "row_delay": "2e-6",
        "scenes": "glass",
        "sensor": "spad-320x240",
        "shard": "1/2",
        "size": "64x64",
        "span": "1e-3",
        "speed": "3",
        "static": "counts.npy 1e-5",
        "stream": "s",
        "streams": "s",
        "temperature": "60",
        "title": "Mine",
        "to": "png",
        "transfer": "srgb",
        "validate.output": "other.png",
        "variable": "b",
        "white": "0.5",
        "window": "2",
    },
    results={
        "threads": threads,
        "explain": stdout,
        "output": names,
        "sense.pixel_pitch": described,
        "convert.exposure": described,
        "convert.sensor": described,
        "convert.ppp": described,
    },
    may_be_silent=frozenset({"threads", "force", "memory", "workers", "retry", "repair", "wait"}),
    prepared=frozenset({"replay", "shard_size"}),
    never_here={
        "generate.workers": "speed alone",
        "generate.memory": "speed alone",
        "generate.wait": "waits for another process",
        "generate.cluster": "no cluster is there",
        "generate.gpus": "no cluster is there",
        "tradeoff.paper_figure": "needs a clip of 511 frames; tests/qsim/cli/test_tradeoff.py",
        "tradeoff.colour": "needs a fast clip of three bands; tests/qsim/studies/bit_depth/test_clip_study.py",
        "generate.threads": "its workers render",
        **{
            f"validate.{name}": "a measurement of minutes; tests/qsim/studies/validation"
            for name in ("output", "pixels", "require_speed", "force")
        },
    },
)


@pytest.fixture(scope="session")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the rows name."""
    import h5py
    import tifffile
    from PIL import Image
    from scipy.io import savemat

    folder = tmp_path_factory.mktemp("work")
    rng = np.random.default_rng(0)
    static = rng.poisson(5.0, (60, 16, 16)).astype(np.uint8)
    flow = np.stack([np.full((16, 24), 1.5), np.zeros((16, 24))])
    clip = write_clip(folder / "clip", frames=16, height=16, width=24)
    assert main(["sense", str(clip.path), "--ppp", "3.25", "--bits", "3", "--name", "s", "-q"]) == 0
    assert main(["sense", str(clip.path), "--sensor", "spad-320x240", "--name", "b", "-q"]) == 0
    write_clip(folder / "fast", frames=16, height=16, width=24, frame_rate=20000.0, exposure=5e-5, flow=flow)
    write_clip(folder / "wide", frames=16, height=64, width=96, frame_rate=20000.0, exposure=5e-5)
    write_clip(folder / "relative", frames=3, height=16, width=24, relative=True)
    bands = write_clip(folder / "bands", frames=6, height=5, width=9)
    for seed, name in enumerate(("red", "green", "blue")):
        bands.sense("spad512s", ppp=0.4, bits=1, seed=seed, name=name)
    colour_clip(folder / "coloured")
    write_camera_path(folder / "path.json", Camera(2e-4, 2.8, 1e-5, 16, 24, origin=(0, 0, 3)), frames=2, frame_rate=2e3)
    (folder / "rest").mkdir()
    write_records(folder / "rest")
    np.save(folder / "codes.npy", rng.integers(0, 4, (3, 16, 24)).astype(np.uint8))
    np.save(folder / "values.npy", rng.random((3, 16, 24)).astype(np.float32))
    np.save(folder / "light.npy", rng.integers(0, 60000, (3, 16, 24)).astype(np.uint16))
    np.save(folder / "cube.npy", rng.integers(0, 256, (3, 16, 2)).astype(np.uint8))
    np.save(folder / "colour.npy", rng.integers(0, 256, (3, 16, 2, 3)).astype(np.uint8))
    (folder / "spikes.dat").write_bytes(rng.integers(0, 256, 2 * 16 * 8 // 8).astype(np.uint8).tobytes())
    savemat(folder / "two.mat", {"a": static, "b": static + 1})
    with h5py.File(folder / "two.h5", "w") as file:
        file["a"] = static
        file["b"] = static + 1
    tifffile.imwrite(folder / "stack.tif", np.stack([static, static + 1], axis=1), metadata={"axes": "TCYX"})
    (folder / "raw.bin").write_bytes(
        rng.integers(0, 256, 9600).astype(np.uint8).tobytes()
    )  # 25 frames, or 24 with a byte behind each row
    (folder / "words.bin").write_bytes(rng.integers(0, 256, (3, 16, 48)).astype(np.uint8).tobytes())
    (folder / "deep.bin").write_bytes(static.astype("<u2").tobytes())
    (folder / "dark.bin").write_bytes(np.packbits(rng.random((400, 6, 8)) < 0.01).tobytes())
    (folder / "gaps").mkdir()
    for t in (1, 2, 4):
        Image.fromarray(rng.integers(0, 256, (16, 24)).astype(np.uint8)).save(folder / f"gaps/{t}.png")
    (folder / "stretched").mkdir()
    for t in range(2):
        Image.fromarray(rng.choice([0, 85, 170, 255], (16, 24)).astype(np.uint8)).save(folder / f"stretched/{t}.png")
    (folder / "still.py").write_text(
        "from small_scenes import plate\n\n\ndef scene(seed=0, *, speed=1.0):\n    return plate(None)\n"
    )
    (folder / "bad.toml").write_text("[defects]\nprnu = 0.5\n")
    spad = '[sensor]\nmodel = "CountingSPAD"\nbits = 3\npde = 0.5\ndark_count_rate = 100.0\ndead_time = 2e-5\n'
    (folder / "my.toml").write_text(spad)
    (folder / "counter.toml").write_text(spad)
    (folder / "warm.toml").write_text(
        '[sensor]\nmodel = "BinarySPAD"\nbits = 1\npde = 0.5\ndark_count_rate = 100.0\n'
        "dark_doubling = 8.0\ndark_reference = 20.0\n"
    )
    head = "[recipe]\nname='t'\nframes=2\nheight=16\nwidth=16\npsnr=20.0\n"
    (folder / "t.toml").write_text(f"{head}[[scenes]]\nfamily='fan'\ncount=2\n")
    (folder / "fails.py").write_text(
        "import os\nfrom small_scenes import plate\n\n\n"
        "def scene(seed=0, *, speed=1.0):\n    assert os.path.isdir('ready')\n    return plate(None)\n"
    )
    (folder / "broken.toml").write_text(f"{head}[[scenes]]\nfamily='fails.py'\n")
    np.save(folder / "planes.npy", (rng.random((400, 6, 8)) < 0.01).astype(np.uint8))
    np.save(folder / "lit.npy", (rng.random((400, 6, 8)) < 0.4).astype(np.uint8))
    np.save(folder / "sums.npy", rng.binomial(50, 0.02, (100, 6, 8)).astype(np.uint8))
    np.save(folder / "counts.npy", static)
    np.save(folder / "turned.npy", static.transpose(1, 2, 0))
    for n, mean in enumerate((0.02, 0.5, 1.5, 3.0)):
        electrons = rng.poisson(mean, (400, 12, 16)) + rng.normal(0, 0.2, (400, 12, 16))
        np.save(folder / f"q{n}.npy", np.clip(np.round(electrons), 0, 7).astype(np.uint8))
    return folder


LINES = {"demo": "demo t.toml", "completion": "completion bash"}  # of commands without options of their own
FIRST = {one.command: one for one in reversed(SITUATIONS)}


def lines() -> list[Any]:
    """A line that each command takes."""
    found = []
    for command in COMMANDS.program.commands:
        slow = [pytest.mark.slow] if command in FIRST and FIRST[command].slow else []
        line = FIRST[command].line if command in FIRST else LINES[command]
        found.append(pytest.param(line, id=command, marks=slow))
    return found


@pytest.mark.parametrize("line", [one.values[0] for one in lines()])
def test_a_command_is_quiet_or_verbose(line, tmp_path, capsys, monkeypatch):
    check_printing(COMMANDS, line, tmp_path, capsys, monkeypatch)


@pytest.mark.parametrize("line", lines())
def test_a_command_prints_an_object_for_programs(line, work, tmp_path, capsys, monkeypatch):
    check_json(COMMANDS, line, work, tmp_path, capsys, monkeypatch)


@pytest.mark.parametrize(("setting", "situations", "everywhere"), list(COMMANDS.cases()))
@pytest.mark.filterwarnings("ignore:gaps. numbers in the names")
@pytest.mark.filterwarnings("ignore:between frames")  # --rate of frames that are noise
def test_a_setting_acts_or_is_refused(setting, situations, everywhere, work, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(look.time, "sleep", print)
    Bench(COMMANDS, work, tmp_path, capsys, monkeypatch).check(setting, situations, everywhere)


def test_a_setting_that_is_ignored_is_found(work, tmp_path, capsys, monkeypatch):
    """Another description is not an effect, an accepted option is not refused, and a setting has to act somewhere."""

    def ignores(words: list[str]) -> int:
        Path("made.json").write_text(str("--bits" in words))
        return 0

    def refuses(words: list[str]) -> int:
        if "--bits" in words:
            print("qsim: sense: --bits changes nothing; leave it out", file=sys.stderr)
            return 2
        return 0

    (bits,) = (one for one in COMMANDS.settings("sense") if one.name == "bits")
    situation = [Situation("sense clip --name other")]
    with pytest.raises(AssertionError, match="changes nothing"):
        Bench(replace(COMMANDS, main=ignores), work, tmp_path / "a", capsys, monkeypatch).check(bits, situation, True)
    refused = Bench(replace(COMMANDS, main=refuses), work, tmp_path / "b", capsys, monkeypatch)
    refused.check(bits, situation, False)
    with pytest.raises(AssertionError, match="acts in no situation"):
        Bench(replace(COMMANDS, main=refuses), work, tmp_path / "c", capsys, monkeypatch).check(bits, situation, True)
