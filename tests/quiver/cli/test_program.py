"""The command line: the complete chain, examples in the help, one clear line for every mistake."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from clips import describe_video
from golden import published_state
from safetensors.torch import save_file

from qsim import colour
from qsim.cli.program import main as qsim_main
from qsim.locks import Lock
from qsim.words import memory_size
from quiver.cli.program import main
from quiver.data.clips import open_clips

ROOT = Path(__file__).parents[3]
COMMANDS = ("train", "restore", "evaluate", "domain", "ablate", "bench", "convert-weights")


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    code = main([str(word) for word in words])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def mistake(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """Return the one line of a mistake, which has exit code 2."""
    code, out, err = run(capsys, *words)
    assert code == 2
    assert out == ""
    assert err.count("\n") == 1
    assert "Traceback" not in err
    return err


@pytest.fixture
def clip(tiny_dataset: Path) -> Path:
    return open_clips(tiny_dataset, "test")[0].path


def train_words(data: Path, out: Path) -> list[object]:
    small = ["--crop", 16, "--batch", 1, "--preset", "unet", "--protocol", "control", "--validate-every", 2]
    return ["train", data, "-o", out, "--steps", 2, *small]


def test_the_whole_chain(capsys, tiny_dataset, clip, tmp_path):
    """Train, resume, restore with the run, evaluate it beside a classical method."""
    run_folder = tmp_path / "run"
    video = tmp_path / "video.npy"
    code, out, _ = run(capsys, *train_words(tiny_dataset, run_folder), "--json")
    found = json.loads(out)
    assert (code, found["steps"]) == (0, 2)
    assert (run_folder / "curve.png").read_bytes().startswith(b"\x89PNG")
    code, again, _ = run(capsys, *train_words(tiny_dataset, run_folder), "--json")
    assert json.loads(again)["last_validation"] == found["last_validation"]

    code, out, _ = run(capsys, "restore", clip, "-o", video, "--method", run_folder, "--ppp", 3.25, "--json")
    assert code == 0
    assert np.load(video).shape == tuple(json.loads(out)["shape"]) == (14, 36, 44)

    methods = f"moment:1,{run_folder}"
    code, out, _ = run(
        capsys, "evaluate", tiny_dataset, "-o", tmp_path / "table", "--methods", methods, "--ppp", "3.25,26"
    )
    assert code == 0
    assert "| run | 11 (5) | 26 PPP, 3 bit |" in out
    assert (tmp_path / "table/evaluation.md").read_text() in out + "\n"


def test_static_photons(capsys):
    counts = ROOT / "tests" / "data" / "hazelnut_gates6.npz"
    code, out, _ = run(capsys, "evaluate", "--static", counts, "--methods", "naive,moment", "--splits", 1, "--json")
    assert code == 0
    assert [score["method"] for score in json.loads(out)["scores"]] == ["naive", "moment"]


def test_a_stored_stream_by_clip_by_name_and_by_file(capsys, make_clip, tmp_path):
    from qsim.streams.sensing import Sensing
    from qsim.streams.storing import sense

    clip = make_clip()
    sense(clip, Sensing("quiver-physical", bits=3, ppp=3.25, name="mine"))
    ways = ([clip.path], [clip.path, "--stream", "mine"], [clip.path / "streams/mine.npy"], [clip.path, "--ppp", 3.25])
    results = []
    for i, way in enumerate(ways):
        path = tmp_path / f"{i}.npy"
        assert run(capsys, "restore", *way, "-o", path, "--method", "moment")[0] == 0
        results.append(np.load(path))
    assert all(np.array_equal(results[0], result) for result in results[1:])


def test_a_stream_has_one_white(capsys, tmp_path, make_clip):
    """Restoring names that of the sensor; pictures name the brightest light that they show."""
    clip = make_clip()
    stream = clip.sense("quiver-physical", bits=3, ppp=3.25)
    _, out, err = run(capsys, "restore", clip.path, "-o", tmp_path / "r.npy", "--method", "moment")
    white = stream.sensor.white(stream.exposure)
    assert re.findall(r" white(.*?) = ([0-9.]+)", out + err) == 2 * [(" of the sensor", f"{white:.4g}")]
    assert qsim_main(["preview", str(tmp_path / "r.npy"), "-o", str(tmp_path / "r.png")]) == 0
    shown = capsys.readouterr().out
    assert " white" not in shown
    brightest = colour.peak(np.load(tmp_path / "r.npy"))
    assert f"brightest shown = {brightest:.4g} photons" in shown


def test_a_photon_cube(capsys, tmp_path):
    planes = np.random.default_rng(0).integers(0, 2, (70, 6, 13), dtype=np.uint8)
    np.save(tmp_path / "cube.npy", np.packbits(planes, axis=2))
    words = ["--width", 13, "--planes", 7, "--sensor", "spad-320x240", "--frame-rate", 9996, "--method", "moment"]
    code, out, _ = run(capsys, "restore", tmp_path / "cube.npy", "-o", tmp_path / "v.npy", *words, "--json")
    assert code == 0
    assert json.loads(out)["white"] == pytest.approx(7.0)
    assert np.load(tmp_path / "v.npy").shape == (10, 6, 13)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_shows_an_example_and_speaks_json(capsys, command):
    code, out, _ = run(capsys, command, "--help")
    assert code == 0
    assert f"quiver {command}" in out.split("example:")[1]
    assert "--json" in out


def test_module_and_import(tmp_path):
    """`python -m quiver` works anywhere; importing the command line loads neither torch nor the renderer."""
    shown = subprocess.run(
        [sys.executable, "-m", "quiver", "--help"], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    assert all(command in shown.stdout for command in COMMANDS)
    code = "import quiver.cli, sys; print({'torch', 'mitsuba', 'scipy'} & set(sys.modules))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path)
    assert loaded.stdout.strip() == "set()"


def test_misspelled_words_are_suggested(capsys):
    assert "did you mean '--method'?" in mistake(capsys, "restore", "x", "-o", "y.npy", "--metod", "moment")
    assert "did you mean 'restore'?" in mistake(capsys, "restor", "x")
    assert "did you mean 'published'?" in mistake(
        capsys, "train", "x", "-o", "y", "--protocol", "publishd", "--steps", 1
    )


def test_missing_things_are_named(capsys, tmp_path, tiny_dataset, clip):
    gone = tmp_path / "gone"
    assert f"{gone}: no such file" in mistake(capsys, "restore", gone, "-o", tmp_path / "v.npy", "--method", "moment")
    assert f"{gone}: no such data set" in mistake(capsys, "evaluate", gone, "-o", tmp_path / "t")
    assert f"{gone}: no such data set" in mistake(capsys, "train", gone, "-o", tmp_path / "r", "--steps", 1)
    assert "no method 'momnt' (did you mean 'moment'?)" in mistake(
        capsys, "evaluate", tiny_dataset, "-o", gone, "--methods", "momnt"
    )
    assert "no such file" in mistake(capsys, "evaluate", "--static", gone)
    assert "give a data set" in mistake(capsys, "evaluate")
    assert "give a training length, as --steps or as --minutes" in mistake(
        capsys, "train", tiny_dataset, "-o", tmp_path / "r"
    )
    assert "choose one of its streams" in mistake(
        capsys, "restore", clip, "-o", tmp_path / "v.npy", "--method", "moment"
    )
    assert "is a data set; name one of its clips" in mistake(capsys, "restore", tiny_dataset, "-o", tmp_path / "v.npy")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--ppp", "nan"], "expected a number from 1e-06 to 1e+06, got 'nan'"),
        (["--ppp", "-3"], "expected a number from 1e-06 to 1e+06, got '-3'"),
        (["--bits", "0"], "expected a whole number from 1 to 16, got '0'"),
        (["--memory", "lots"], "expected a size such as 2GB"),
        (["--mode", "fast"], "fast"),
        (["--sensor", "quiver-fysical", "--ppp", "3"], "quiver-fysical"),
    ],
)
def test_impossible_values_are_named(capsys, clip, tmp_path, words, message):
    assert message in mistake(capsys, "restore", clip, "-o", tmp_path / "v.npy", "--method", "moment", *words)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros((0, 4, 4), np.uint8), "expected whole codes [T, H, W] without an empty axis"),
        (np.zeros((3, 0, 4), np.uint8), "expected whole codes [T, H, W] without an empty axis"),
        (np.full((3, 4, 4), np.nan), "expected whole codes"),
        (np.full((3, 4, 4), 9, np.uint8), "code 9 at (t, y, x) = (0, 0, 0); a 3-bit sensor has 0..7"),
    ],
)
def test_arrays_that_are_no_stream_are_refused(capsys, tmp_path, array, message):
    np.save(tmp_path / "a.npy", array)
    words = ["--sensor", "quiver-paper", "--method", "moment"]
    assert message in mistake(capsys, "restore", tmp_path / "a.npy", "-o", tmp_path / "v.npy", *words)
    assert [path.name for path in tmp_path.iterdir()] == ["a.npy"]


def test_restored_video_is_not_taken_for_a_stream(capsys, tmp_path):
    np.save(tmp_path / "v.npy", np.ones((3, 4, 4), np.float32))
    describe_video(tmp_path / "v.json")
    said = mistake(capsys, "restore", tmp_path / "v.npy", "-o", tmp_path / "w.npy", "--method", "moment")
    assert "v.npy: is restored video; name the stream" in said
    assert not (tmp_path / "w.npy").exists()


def test_unreadable_files_are_named(capsys, tmp_path):
    (tmp_path / "a.npy").write_text("not an array")
    words = ["--sensor", "quiver-paper", "--method", "moment"]
    assert "a.npy: not readable as .npy" in mistake(
        capsys, "restore", tmp_path / "a.npy", "-o", tmp_path / "v.npy", *words
    )
    (tmp_path / "w.safetensors").write_text("not weights")
    np.save(tmp_path / "c.npy", np.zeros((3, 4, 4), np.uint8))
    words = ["--sensor", "quiver-paper", "--method", tmp_path / "w.safetensors"]
    assert "not a safetensors file" in mistake(capsys, "restore", tmp_path / "c.npy", "-o", tmp_path / "v.npy", *words)


def test_nothing_is_overwritten_without_force(capsys, tmp_path, tiny_dataset, clip):
    video = tmp_path / "v.npy"
    video.write_text("mine")
    words = ["restore", clip, "-o", video, "--method", "moment", "--ppp", 3.25]
    assert "exists; name another, or replace it with --force" in mistake(capsys, *words)
    assert video.read_text() == "mine"
    assert "has no .json that describes restored video" in mistake(capsys, *words, "--force")
    assert video.read_text() == "mine"
    video.unlink()
    assert run(capsys, *words)[0] == 0
    assert "exists; name another, or replace it with --force" in mistake(capsys, *words)
    assert run(capsys, *words, "--force")[0] == 0
    assert np.load(video).shape == (14, 36, 44)
    for name in ("v", "v.mp4"):
        assert "written as .npy" in mistake(capsys, "restore", clip, "-o", tmp_path / name, "--ppp", 3.25)
        assert not (tmp_path / name).exists()

    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "thesis.txt").write_text("mine")
    assert "is not a training run" in mistake(capsys, *train_words(tiny_dataset, folder))
    assert "only what this program made is removed" in mistake(capsys, *train_words(tiny_dataset, folder), "--force")
    assert "is not an evaluation" in mistake(capsys, "evaluate", tiny_dataset, "-o", folder)
    assert "only what this program made is removed" in mistake(
        capsys, "evaluate", tiny_dataset, "-o", folder, "--force"
    )
    assert (folder / "thesis.txt").read_text() == "mine"


def test_force_starts_a_run_and_a_table_again(capsys, tmp_path, tiny_dataset):
    assert run(capsys, *train_words(tiny_dataset, tmp_path / "r"))[0] == 0
    other = [*train_words(tiny_dataset, tmp_path / "r"), "--seed", 1]
    assert "holds a run with seed 0, now it is 1" in mistake(capsys, *other)
    assert run(capsys, *other, "--force")[0] == 0
    assert run(capsys, "evaluate", tiny_dataset, "-o", tmp_path / "t", "--methods", "moment")[0] == 0
    other = ["evaluate", tiny_dataset, "-o", tmp_path / "t", "--methods", "moment", "--seed", 1]
    assert "holds another evaluation" in mistake(capsys, *other)
    assert run(capsys, *other, "--force")[0] == 0


def test_force_removes_no_evaluation_before_the_new_one_is_checked(capsys, tmp_path, make_clip):
    folder = make_clip(frames=9, split="test").path.parent
    out = tmp_path / "t"
    words = ["evaluate", folder, "-o", out, "--methods", "naive"]
    assert run(capsys, *words)[0] == 0
    before = (out / "rows.jsonl").read_bytes()
    for more, message in (("--split=val", "no finished clip in split 'val'"), ("--published", "frames are too few")):
        assert message in mistake(capsys, *words, more, "--force")
        assert (out / "rows.jsonl").read_bytes() == before


def test_one_evaluation_at_a_time(capsys, tmp_path, clip):
    out = tmp_path / "t"
    words = ["evaluate", clip, "-o", out, "--methods", "naive"]
    assert run(capsys, *words)[0] == 0
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    with Lock(out / "lock") as lock:
        assert lock.acquire()
        for more in ([], ["--force"], ["--seed", 1, "--force"]):
            assert f"{out}: another process evaluates here; wait" in mistake(capsys, *words, *more)
    assert {path: path.read_bytes() for path in before} == before
    assert run(capsys, *words, "--force")[0] == 0  # a killed process leaves the file
    assert not (out / "lock").exists()


def test_a_clip_is_not_evaluated_into_the_folder_of_its_clips(capsys, clip, make_clip):
    """With --force the second evaluation removed them as clips of a test set."""
    own = make_clip()
    words = ["evaluate", own.path, "-o", own.path.parents[1], "--methods", "naive", "--split", "all"]
    for more in ([], ["--force"]):
        assert "overlaps with" in mistake(capsys, *words, *more)
    assert own.verify() == []
    assert "is not an evaluation" in mistake(capsys, "evaluate", clip, *words[2:])


def test_an_evaluation_does_not_stand_in_a_clip(capsys, make_clip):
    own = make_clip()
    said = mistake(capsys, "evaluate", own.path, "-o", own.path / "table", "--methods", "naive")
    assert "is part of a clip" in said
    assert not (own.path / "table").exists()


def test_the_help_says_whose_threads_are_kept(capsys):
    for command in COMMANDS:
        text = " ".join(run(capsys, command, "--help")[1].split())
        kept = "resumed work keeps its number" in text
        assert kept == (command in ("train", "restore", "ablate")), command


def test_a_checkpoint_that_is_none_is_refused(capsys, tmp_path):
    (tmp_path / "a.pth").write_bytes(b"\x80\x04not a checkpoint")
    assert "a.pth" in mistake(capsys, "convert-weights", tmp_path / "a.pth", "-o", tmp_path / "a.safetensors")
    assert not (tmp_path / "a.safetensors").exists()


def test_converted_weights_replace_weights_only(capsys, tmp_path):
    """Not the checkpoint that is converted, nor another file: only weights of this program, with --force."""
    theirs, named, notes = (tmp_path / name for name in ("their.pth", "their.safetensors", "notes.safetensors"))
    torch.save(published_state(), theirs)
    save_file({name: value.clone() for name, value in published_state().items()}, named)
    notes.write_text("mine")
    held = {path: path.read_bytes() for path in (theirs, named, notes)}
    for source, output, message in (
        (theirs, theirs, "their.pth: weights are written as .safetensors"),
        (named, named, "their.safetensors: does not hold weights of this program"),
        (theirs, notes, "notes.safetensors: does not hold weights of this program"),
    ):
        assert message in mistake(capsys, "convert-weights", source, "-o", output, "--force")
    assert {path: path.read_bytes() for path in held} == held
    words = ["convert-weights", theirs, "-o", tmp_path / "ours.safetensors"]
    code, said, _ = run(capsys, *words)
    assert code == 0
    assert "restored light is right up to a factor" in said
    assert "exists" in mistake(capsys, *words)
    assert run(capsys, *words, "--force")[0] == 0


@pytest.mark.parametrize(("text", "bytes_"), [("2GB", 2e9), ("500MB", 5e8), ("1.5GiB", 1.5 * 2**30), ("4096", 4096)])
def test_sizes(text, bytes_):
    assert memory_size(text) == bytes_


@pytest.mark.slow
def test_the_ablation(capsys, tiny_dataset, tmp_path):
    """Six networks of nearly one size, one table; the second call returns at once, because everything exists."""
    words = [
        "ablate",
        tiny_dataset,
        "-o",
        tmp_path / "a",
        "--steps",
        1,
        "--crop",
        16,
        "--batch",
        1,
        "--mode",
        "streaming",
    ]
    code, out, _ = run(capsys, *words)
    assert code == 0
    lines = out.strip().splitlines()[2:]
    assert lines[0].startswith("| no | no | no |")
    sizes = [int(line.split("|")[4].replace(",", "")) for line in lines]
    assert max(sizes) < 1.05 * min(sizes)
    assert run(capsys, *words)[1] == out


@pytest.mark.slow
def test_bench(capsys, tmp_path):
    words = ["bench", "--methods", "moment,unet", "--size", "32x24", "--threads", 1, "-o", tmp_path / "b"]
    code, out, _ = run(capsys, *words, "--json")
    moment, unet = json.loads(out)["costs"]
    assert code == 0
    assert moment["psnr_matched"] > 15
    assert unet["psnr_matched"] is None  # random weights: a cost, no score
    assert 0.05 < unet["gmac_per_frame"] < 0.2
    assert {path.name for path in (tmp_path / "b").iterdir()} == {"bench.json", "bench.md", "bench.png"}
    assert "replace it with --force" in mistake(capsys, *words)
