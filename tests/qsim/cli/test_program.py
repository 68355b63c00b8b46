"""Tests the command line: one line for wrong input, JSON for programs, nothing lost on Ctrl-C."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fakes
import numpy as np
import pytest
from clips import describe_video

from qsim.cli import dataset
from qsim.cli.program import main
from qsim.clip.clip_info import RELATIVE
from qsim.clip.writer import ClipWriter
from qsim.dataset import generation, recipe
from qsim.dataset.dataset import Dataset
from qsim.files import Progress
from qsim.streams.clip import Clip

COMMANDS = ("doctor", "render", "sense", "generate", "plan", "check", "convert")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small data set, made by the quick renderer."""
    folder = tmp_path_factory.mktemp("cli") / "small"
    generation.generate(recipe.parse(fakes.RECIPE), folder, generation.Options(workers=0), make=fakes.make)
    return folder


def relative(path: Path, scale: float = 1.0) -> Path:
    meta = {"shape": [2, 8, 10], "frame_rate": 100.0, "exposure": 1e-3, "radiance_unit": RELATIVE, "camera": None}
    with ClipWriter(path, meta) as writer:
        for t in range(2):
            writer.add(t, scale * np.random.default_rng(t).random((8, 10)))
    return path


def run(capsys: pytest.CaptureFixture[str], *args: object) -> tuple[int, str, str]:
    code = main([str(arg) for arg in args])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


@pytest.mark.parametrize("command", COMMANDS)
def test_every_help_has_an_example_and_json(capsys: pytest.CaptureFixture[str], command: str):
    code, out, _ = run(capsys, command, "--help")
    assert code == 0
    assert f"example:\n  qsim {command} " in out or f"example:\n  qsim {command}\n" in out
    assert "--json" in out


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("rendr fan", "qsim: unknown command 'rendr' (did you mean 'render'?)"),
        ("sense x --sensr y", "qsim sense: unknown option --sensr (did you mean '--sensor'?)"),
        ("sense x --bit 3", "qsim sense: unknown option --bit (did you mean '--bits'?)"),
        ("sense x --bits three", "qsim sense: argument --bits: expected a whole number from 1 to 16, got 'three'"),
        ("sense x --ppp 3,-1", "qsim sense: argument --ppp: expected a number from 1e-06 to 1e+06, got"),
        ("sense x --ppp bright", "qsim sense: argument --ppp: expected a number from 1e-06 to 1e+06, got"),
        ("sense", "qsim sense: the following arguments are required: PATH"),
        ("sense /none", "qsim: /none: no such clip"),
        ("sense /none --ppp 1 --lux 1", "qsim: give the light level as ppp or as lux, not both"),
        ("generate /none.toml", "qsim: /none.toml: no such recipe"),
        ("generate x --shard 3", "qsim generate: argument --shard: expected I/N"),
        ("generate x --shard 0/3", "qsim generate: argument --shard: expected I/N"),
        ("generate x --shard 4/3", "qsim generate: argument --shard: expected I/N"),
        ("render nofamily -o never/made", "qsim: no scene family 'nofamily'; there are "),
        (
            "render fan -o never/made --height 0",
            "qsim render: argument --height: expected a whole number from 1 to 100000, got '0'",
        ),
        (
            "render fan -o never/made --frames 0",
            "qsim render: argument --frames: expected a whole number from 1 to 100000, got '0'",
        ),
        ("check /none", "qsim: /none: no such clip"),
        ("convert /none never/made", "qsim: /none: no such file"),
        ("plan /none.toml", "qsim: /none.toml: no such recipe"),
    ],
)
def test_a_mistake_is_one_line_and_code_2(capsys: pytest.CaptureFixture[str], line: str, message: str):
    code, out, err = run(capsys, *line.split())
    assert code == 2
    assert out == ""
    assert err.startswith(message), err
    assert err.count("\n") == 1
    assert not Path("never/made").exists()


def test_render_explains_and_counts(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any):
    """--explain without -o renders nothing; with it the clip is made too; the lens's limit is printed either way."""
    monkeypatch.delenv("QSIM_ENGINE", raising=False)
    small = ("--height", 8, "--width", 10, "--psnr", 20, "--frames", 1)
    code, out, _ = run(capsys, "render", "plain", "--explain", *small)
    assert code == 0
    for word in (
        "samples",
        "bounces",
        "motion blur",
        "depth of field",
        "Airy disk 3.4 px wide, MTF 0.19",
        "not modelled",
    ):
        assert word in out
    code, out, _ = run(capsys, "render", "plain", "-o", tmp_path / "clip", *small)
    assert code == 0
    assert "Airy disk 3.4 px wide, MTF 0.19 at Nyquist (f/2.8, 550 nm, 1.1 um)" in out
    assert "pixels are fireflies (Monte-Carlo outliers); " in out
    assert "bounces" not in out
    code, _, err = run(capsys, "render", "plain", *small)
    assert code == 2
    assert "-o/--output is required (optional only with --explain)" in err
    code, _, err = run(capsys, "render", "plain", "--explain", "--engine", "metal")
    assert code == 2
    assert "metal" in err


def test_sense_prints_one_line_of_light(made: Path, capsys: pytest.CaptureFixture[str]):
    clip = made / "clips" / "fan_0001"
    code, out, _ = run(capsys, "sense", clip, "--bits", 2, "--ppp", 3.25)
    assert code == 0
    assert re.fullmatch(
        r"wrote \S+/fan_0001/streams/quiver-physical_2bit_3.25ppp\.npy: 3 codes of 2 bits, 8 x 10 pixels, "
        r"2000 codes/s; light "
        r"scaled by \S+ to 3.25 photons/pixel \(2.6 e-, equivalent to \S+ lx at 555 nm\)\n",
        out,
    )
    assert "exists already: " in run(capsys, "sense", clip, "--bits", 2, "--ppp", 3.25)[1]
    stream = Clip.open(clip).stream("quiver-physical_2bit_3.25ppp")
    assert stream.codes().max() <= 3
    assert stream.info.sensing.ppp == 3.25


def test_sense_again_with_other_light_over_a_data_set(made: Path, capsys: pytest.CaptureFixture[str]):
    before = {path: path.read_bytes() for path in made.rglob("*.exr")}
    code, out, _ = run(capsys, "sense", made, "--bits", 3, "--ppp", "0.5,26", "--json")
    assert code == 0
    found = json.loads(out)["streams"]
    assert [(Path(s["clip"]).name, s["ppp"]) for s in found] == [
        (name, ppp) for name in ("fan_0000", "fan_0001", "tumble_0004") for ppp in (0.5, 26.0)
    ]
    assert {path: path.read_bytes() for path in made.rglob("*.exr")} == before
    assert Dataset.open(made).verify() == []


def test_sensing_is_idempotent_and_never_overwrites_silently(made: Path, capsys: pytest.CaptureFixture[str]):
    clip = made / "clips" / "fan_0000"
    arguments = ["sense", clip, "--bits", 3, "--ppp", 7, "-o", "mine"]
    assert run(capsys, *arguments)[0] == 0
    first = (clip / "streams" / "mine.npy").stat().st_mtime_ns
    assert run(capsys, *arguments)[0] == 0
    assert (clip / "streams" / "mine.npy").stat().st_mtime_ns == first
    code, _, err = run(capsys, *arguments, "--seed", 1)
    assert code == 2
    assert "exists with other settings; give the stream a --name, or replace it with --force" in err
    old = Clip.open(clip).stream("mine").codes()
    assert run(capsys, *arguments, "--seed", 1, "--force")[0] == 0
    assert (Clip.open(clip).stream("mine").codes() != old).any()


def test_replay_draws_the_stored_frame_again(made: Path, capsys: pytest.CaptureFixture[str]):
    name = "quiver-physical_3bit_3.25ppp"
    code, out, _ = run(capsys, "sense", made, "--name", name, "--replay", "fan_0001:2", "--json")
    assert code == 0
    assert json.loads(out) == {"clip": "fan_0001", "stream": name, "frame": 2, "pixels": 80, "differ": 0}
    for wrong, message in [
        ("fan_0001:3", "frame 3 does not exist"),
        ("fan_0009:0", "no clip fan_0009"),
        ("x", "CLIP:FRAME"),
    ]:
        code, _, err = run(capsys, "sense", made, "--name", name, "--replay", wrong)
        assert code == 2
        assert message in err


def test_replay_tells_a_changed_frame(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    clip = relative(tmp_path / "r")
    assert run(capsys, "sense", clip, "--bits", 3, "--ppp", 3.25)[0] == 0
    path = next((clip / "streams").glob("*.npy"))
    content = bytearray(path.read_bytes())
    content[-1] ^= 0b11100  # of a code within the width: 10 codes fill 30 of 32 bits
    path.write_bytes(content)
    code, out, _ = run(capsys, "sense", clip, "--replay", "r:1")
    assert code == 1
    assert "1 of 80 pixels DIFFER" in out


def test_relative_light_needs_a_target(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    clip = relative(tmp_path / "r")
    code, _, err = run(capsys, "sense", clip, "--bits", 3)
    assert code == 2
    assert "its radiance is relative" in err
    assert "--ppp 3.25" in err
    assert not (clip / "streams").exists()


def test_a_black_clip_has_no_light_level(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    code, _, err = run(capsys, "sense", relative(tmp_path / "black", 0.0), "--ppp", 3.25)
    assert code == 2
    assert "black: mean of photons is 0, no factor reaches 3.25 PPP" in err


def test_a_sum_of_planes_groups_clip_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Two bits are three planes: 7 frames give 2 codes, of three times the exposure, at a third of the rate."""
    meta = {"shape": [7, 8, 10], "frame_rate": 6000.0, "exposure": 1e-4, "radiance_unit": RELATIVE, "camera": None}
    with ClipWriter(tmp_path / "fast", meta) as writer:
        for t in range(7):
            writer.add(t, np.full((8, 10), 1.0 if t < 3 else 1e-7))
    arguments = [
        "sense",
        tmp_path / "fast",
        "--sensor",
        "spad-320x240",
        "--bits",
        2,
        "--ppp",
        30,
        "--group",
        "-o",
        "sum",
    ]
    assert run(capsys, *arguments)[0] == 0
    stream = Clip.open(tmp_path / "fast").stream("sum")
    assert len(stream) == 2
    assert stream.info.planes_per_code == 3
    assert (stream.info.frame_rate, stream.exposure) == (2000.0, pytest.approx(3e-4))
    codes = stream.codes()
    assert codes[0].mean() > 2.5, "bright planes"
    assert codes[1].mean() < 0.5, "dark planes"
    assert run(capsys, "sense", tmp_path / "fast", "-o", "sum", "--replay", "fast:1")[0] == 0
    code, _, err = run(capsys, "sense", tmp_path / "fast", "--bits", 3, "--ppp", 3, "--group")
    assert code == 2
    assert "--group is for a clocked SPAD (BinarySPAD)" in err


def test_check_names_the_damage(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = tmp_path / "d"
    generation.generate(recipe.parse(fakes.RECIPE), folder, generation.Options(workers=0), make=fakes.make)
    assert run(capsys, "check", folder)[:2] == (0, f"{folder}: every file is what was written\n")
    frame = folder / "clips" / "fan_0000" / "radiance" / "000001.exr"
    frame.write_bytes(frame.read_bytes()[:-1])
    code, out, _ = run(capsys, "check", folder, "--json")
    assert code == 1
    assert json.loads(out)["problems"] == [f"{frame}: contents changed (checksum differs)"]


def test_check_shows_how_far_it_is(made: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    """A data set clip by clip, a clip file by file, its streams included, both to the end."""
    shown: list[tuple[str, str, list[tuple[int, int]]]] = []

    @contextlib.contextmanager
    def recorded(label: str, unit: str) -> Iterator[Progress]:
        shown.append((label, unit, []))
        yield lambda done, total: shown[-1][2].append((done, total))

    monkeypatch.setattr(dataset, "bar", recorded)
    clip = Dataset.open(made).clips()[0]
    assert run(capsys, "check", made, clip.path)[0] == 0
    files = len(clip.info.checksums) + len(clip.streams)
    assert files > 4
    assert shown == [
        (str(made), "clip", [(n, 3) for n in (1, 2, 3)]),
        (str(clip.path), "file", [(n, files) for n in range(1, files + 1)]),
    ]


def test_generate_reports_failures_and_resumes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    path = tmp_path / "r.toml"
    path.write_text(fakes.RECIPE)
    generate = generation.generate

    def with_maker(maker: Any) -> None:
        monkeypatch.setattr(generation, "generate", lambda *args, run: generate(*args, make=maker))

    arguments = ["generate", path, "-o", tmp_path / "d", "--workers", 0]
    with_maker(fakes.fail_on_tumble)
    code, out, _ = run(capsys, *arguments)
    assert code == 1
    assert "2 of 3 clips done, 2 made now" in out
    assert "FAILED tumble_0004: scene tumble: no light and no glowing body" in out
    assert "--retry" in out
    with_maker(fakes.make)
    code, out, _ = run(capsys, *arguments, "--retry", "--json")
    assert code == 0
    assert json.loads(out)["made"] == 1


def test_ctrl_c_says_how_to_go_on(tmp_path: Path):
    """A child process: SIGINT during the run, exit code 130, one line; the same command finishes."""
    # A shell's background job ignores SIGINT, and its children with it: begin as a terminal's job does.
    code = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler);"
    code += "import sys, fakes; from qsim.dataset import generation; from qsim import cli; g = generation.generate;"
    code += "generation.generate = lambda *args, run: g(*args, make=fakes.make_once_allowed);"
    code += "sys.exit(cli.main(sys.argv[1:]))"
    recipe_path = tmp_path / "r.toml"
    recipe_path.write_text(fakes.RECIPE)
    tests = Path(__file__).parents[2]
    env = os.environ | {"PYTHONPATH": f"{tests.parent}{os.pathsep}{tests / 'support'}"}
    line = [sys.executable, "-c", code, "generate", str(recipe_path), "-o", str(tmp_path / "d"), "--workers", "2"]
    first = subprocess.Popen(line, env=env, stderr=subprocess.PIPE, text=True, start_new_session=True)
    end = time.monotonic() + 60
    while not list((tmp_path / "d" / "logs").glob("*.log")):
        assert time.monotonic() < end
        time.sleep(0.01)
    # As a terminal does, to the workers too; to them first, so that the parent cannot hide that they noticed it.
    children = Path(f"/proc/{first.pid}/task/{first.pid}/children").read_text().split()
    for process in [int(child) for child in children]:
        os.kill(process, signal.SIGINT)
    time.sleep(0.5)
    first.send_signal(signal.SIGINT)
    _, err = first.communicate(timeout=60)
    assert first.returncode == 130
    assert "interrupted; the same command resumes where it stopped" in err
    assert "Traceback" not in err
    (tmp_path / "d" / "go").touch()
    subprocess.run(line, env=env, check=True, capture_output=True)
    assert Dataset.open(tmp_path / "d").verify() == []


def test_debug_shows_the_traceback(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("QSIM_DEBUG", "1")
    code, out, err = run(capsys, "check", "/none")
    assert (code, out) == (2, "")
    assert err.startswith("Traceback (most recent call last):\n")


def test_devices_are_listed_with_sources(capsys: pytest.CaptureFixture[str]):
    code, out, _ = run(capsys, "doctor", "--devices", "--json")
    assert code == 0
    assert "quiver-physical" in [device["name"] for device in json.loads(out)["devices"]]
    code, out, _ = run(capsys, "doctor", "--devices")
    assert "read_noise, source: " in out


def test_as_a_module():
    done = subprocess.run([sys.executable, "-m", "qsim", "--version"], capture_output=True, text=True)
    assert (done.returncode, done.stdout[:5]) == (0, "qsim ")


def test_defaults_of_a_recipe_and_applied_defects_are_printed(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = '[recipe]\nname = "mine"\nframes = 2\nheight = 8\nwidth = 10\npsnr = 20\n[[scenes]]\nfamily = "fan"\n'
    Path("mine.toml").write_text(text + 'split = "train"\n')
    monkeypatch.setattr(generation, "generate", lambda *_, **__: generation.Summary(1, 1, 1, {}, ()))
    assert main(["generate", "mine.toml"]) == 0
    words = "out/mine: 1 of 1 clips done, 1 made now; by default frame_rate = 2000, shutter = 0, seed = 0\n"
    assert capsys.readouterr().out == words
    clip = relative(tmp_path / "c")
    Path("d.toml").write_text("[defects]\nprnu = 0.02\ndead = 0.1\n")
    assert (
        "; defects: prnu, dead"
        in run(capsys, "sense", clip, "--sensor", "spad-320x240", "--ppp", 1, "--defects", "d.toml")[1]
    )


def test_restored_video_states_its_own_rates(tmp_path, capsys):
    np.save(tmp_path / "video.npy", np.ones((3, 8, 10), np.float32))
    describe_video(tmp_path / "video.json", frame_rate=1000.0, exposure=2e-4)
    code, out, _ = run(capsys, "convert", tmp_path / "video.npy", tmp_path / "clip")
    assert code == 0
    assert "3 frames of 8 x 10 pixels at 1000 per second, exposure 200 us" in out
    clip = Clip.open(tmp_path / "clip")
    assert (clip.frame_rate, clip.exposure) == (1000.0, 2e-4)
    np.testing.assert_array_equal(clip[:], np.ones((3, 8, 10)))
    code, _, err = run(capsys, "convert", tmp_path / "video.npy", tmp_path / "video.mp4")
    assert code == 2
    assert "write a film with `qsim preview`" in err


def test_a_render_that_is_interrupted_before_its_first_frame_says_so(tmp_path, capsys, monkeypatch):
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("qsim.dataset.scene_rendering.choose_budget", interrupt)
    err = run(capsys, "render", "fan", "-o", tmp_path / "fan")[2].strip()
    assert err.endswith("qsim: interrupted; no incomplete file is left; run the same command again")


def test_a_preview_of_a_damaged_clip_names_the_check(tmp_path, capsys):
    clip = relative(tmp_path / "c")
    (clip / "radiance" / "000001.exr").unlink()
    code, _, err = run(capsys, "preview", clip, "--frame", 1, "-o", tmp_path / "a.png")
    assert code == 2
    assert "the clip is damaged, run `qsim check" in err


@pytest.mark.parametrize("command", ["plan", "generate"])
def test_a_shard_without_clips_says_so(command: str, capsys: pytest.CaptureFixture[str], tmp_path: Path):
    """An array of jobs may have more parts than clips: no mistake."""
    (tmp_path / "r.toml").write_text(fakes.RECIPE)
    count = len(recipe.load(tmp_path / "r.toml").jobs)
    folder = ["-o", tmp_path / "d"] if command == "generate" else []
    code, out, err = run(capsys, command, tmp_path / "r.toml", *folder, "--shard", f"{count + 1}/{count + 1}")
    assert (code, err) == (0, "")
    assert out.endswith(f"this shard holds none of the {count} clips of small\n")
