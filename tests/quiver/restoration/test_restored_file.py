"""One writer for each restored video, resumed only with equal codes, weights and settings; disks that fill."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from forks import forked, killed_at
from numpy import ndarray as Array

from qsim.scratch import sweep
from qsim.sensor.qis import QIS
from qsim.streams.sensing import Sensing
from qsim.streams.storing import sense
from quiver.cli.program import main
from quiver.data.codes import Codes, array_codes, open_stream, sensed, stream_codes
from quiver.data.illumination import Illumination
from quiver.data.photon_cubes import cube_codes
from quiver.model.unet import UNet, UNetConfig
from quiver.model.weights import annotate, save
from quiver.restoration import restored_file, restorers
from quiver.restoration.interface import RestoreOptions, Restorer
from quiver.restoration.restored_file import restore_to_file
from quiver.restoration.restorers import restorer

SENSOR = QIS(0.8, 1.6, 0.2, 3, gain=3.5 / 3.25)
EXPOSURE = 5e-4


def random_codes(seed: int = 0, frames: int = 10, height: int = 5, width: int = 6) -> Codes:
    drawn = np.random.default_rng(seed).integers(0, 8, (frames, height, width), dtype=np.uint8)
    return array_codes(drawn, SENSOR, EXPOSURE)


@pytest.fixture
def blocks_of_four(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(restored_file, "BLOCK_FRAMES", 4)


def interrupted(codes: Codes, method: Restorer, path: Path) -> None:
    """Stop in the second block of four frames: the first is on the disk."""

    def fill(codes: Codes, out: Array, first: int, progress: object) -> None:
        if first:
            raise KeyboardInterrupt
        method.fill(codes, out, first, None)

    with pytest.raises(KeyboardInterrupt):
        restore_to_file(codes, replace(method, fill=fill), path)
    assert path.with_name(path.name + ".part.json").exists()


def resumed(codes: Codes, method: Restorer, path: Path) -> tuple[list[int], list[str]]:
    """The first frames of the blocks that a second call restored, and its notes."""
    starts: list[int] = []
    said: list[str] = []

    def fill(codes: Codes, out: Array, first: int, progress: object) -> None:
        starts.append(first)
        method.fill(codes, out, first, None)

    restore_to_file(codes, replace(method, fill=fill), path, note=said.append)
    np.testing.assert_allclose(np.load(path), method.restore(codes), rtol=1e-6)
    return starts, said


def test_the_same_restoration_is_resumed(tmp_path, blocks_of_four):
    codes = random_codes()
    moment = restorer("moment")
    interrupted(codes, moment, tmp_path / "r.npy")
    assert resumed(codes, moment, tmp_path / "r.npy") == ([4, 8], [])
    assert sorted(file.name for file in tmp_path.iterdir()) == ["r.json", "r.npy"]


def weights(folder: Path, seed: int) -> Path:
    import torch

    torch.manual_seed(seed)
    network = UNet(UNetConfig(2))
    path = folder / f"{seed}" / "w.safetensors"
    path.parent.mkdir()
    save(network, network.config, path)
    return path


def test_weights_with_other_notes_are_the_same(tmp_path, blocks_of_four):
    """Cells are notes."""
    codes = random_codes()
    path = weights(tmp_path, 0)
    options = RestoreOptions(device="cpu")
    network = restorer(str(path), options)
    interrupted(codes, network, tmp_path / "r.npy")
    annotate(path, {"step": "7"})
    assert resumed(codes, restorer(str(path), options), tmp_path / "r.npy") == ([4, 8], [])


@pytest.mark.parametrize(
    "what", ["stream", "array", "sensed clip", "weights", "window", "precision", "tiles", "sensor"]
)
def test_a_restoration_of_something_else_starts_again(tmp_path, make_clip, blocks_of_four, what):
    """Each change of the answer: all blocks are restored again, and one line gives the reason."""
    before = random_codes()
    after = random_codes()
    old = restorer("moment")
    new = restorer("moment")
    why = "the codes changed"
    match what:
        case "stream":
            clip = make_clip(frames=10)
            both = []
            for seed in (0, 7):
                sensing = Sensing("quiver-physical", bits=3, ppp=3.25, name="mine", seed=seed)
                stream, _ = sense(clip, sensing, force=True)
                both.append(stream_codes(open_stream(stream.path)))
                both[-1].read(0, 1)  # maps the file before it is replaced
            before, after = both
        case "array":
            both = []
            for seed in (0, 1):
                np.save(tmp_path / "codes.npy", random_codes(seed).read(0, 10))
                both.append(cube_codes(tmp_path / "codes.npy", Illumination.of("quiver-paper", None, 3), 2000.0))
                os.unlink(tmp_path / "codes.npy")
            before, after = both
        case "sensed clip":
            clip = make_clip(frames=10)
            before = sensed(clip, Illumination())[0]
            after = sensed(make_clip("other", frames=10, seed=1), Illumination())[0]
            why = "the codes and the source changed"
        case "weights":
            options = RestoreOptions(device="cpu")
            old, new = (restorer(str(weights(tmp_path, seed)), options) for seed in (0, 1))
            why = "weights"
        case "window":
            new = restorer("moment:3")
            why = "the method"
        case "precision":
            path = str(weights(tmp_path, 0))
            old, new = (restorer(path, RestoreOptions(precision=p)) for p in ("float32", "bfloat16"))
            why = "settings"
        case "tiles":
            old = replace(old, cut=lambda height, width: "10 tiles")
            why = "but the tiles of a frame, by memory= and the device, were 10 tiles and are none now"
        case "sensor":
            after = array_codes(after.read(0, 10), replace(SENSOR, gain=1.0), EXPOSURE)
            why = "the sensor"
    interrupted(before, old, tmp_path / "r.npy")
    starts, said = resumed(after, new, tmp_path / "r.npy")
    assert starts == [0, 4, 8]
    assert len(said) == 1
    assert why in said[0]
    assert "starting again" in said[0]


def test_damaged_notes_are_no_obstacle(tmp_path, blocks_of_four):
    codes = random_codes()
    moment = restorer("moment")
    for done in (None, "many"):
        interrupted(codes, moment, tmp_path / "r.npy")
        (tmp_path / "r.npy.part.json").write_text(json.dumps({"format": "quiver-unfinished", "done": done}))
        starts, said = resumed(codes, moment, tmp_path / "r.npy")
        assert starts == [0, 4, 8]
        assert "starting again" in said[0]


@pytest.mark.parametrize("stride", [4, pytest.param(1, marks=pytest.mark.slow)])  # quickly before one event in four
@pytest.mark.parametrize("replaces", [False, True])
def test_killed_anywhere_it_ends_whole(tmp_path, blocks_of_four, replaces, stride):
    """SIGKILL before each event of the file system in turn, with or without an earlier video of this name: the same
    call ends with the same bytes, nothing is left.
    """
    codes = random_codes()
    moment = restorer("moment")
    path = tmp_path / "r.npy"
    expected = restorer("moment").restore(random_codes())

    def earlier() -> None:
        if replaces:
            restore_to_file(codes, restorer("naive"), path)

    step = 1 + replaces
    earlier()
    while killed_at(step, tmp_path, lambda: restore_to_file(codes, moment, path, force=replaces)):
        with contextlib.suppress(FileExistsError):  # killed after it had its name: it is there
            restore_to_file(codes, moment, path, force=replaces)
        np.testing.assert_array_equal(np.load(path), expected)
        assert json.loads((tmp_path / "r.json").read_text())["method"] == "moment"
        sweep(tmp_path)
        for file in tmp_path.iterdir():
            assert file.name in ("r.npy", "r.json", "r.npy.lock"), file
            file.unlink()
        earlier()
        step += stride
    assert step > 15


@pytest.mark.parametrize("said", ["CUDA out of memory. Tried to allocate 2 GiB.", "DefaultCPUAllocator: no memory"])
def test_exhausted_memory_keeps_the_finished_blocks(tmp_path, blocks_of_four, monkeypatch, capsys, said):
    """One sentence, exit code 2; the same call with less memory resumes after the blocks on the disk."""
    source = array_file(tmp_path)
    target = tmp_path / "r.npy"
    starts = []
    fill = restorers.fill_classical

    def exhausted(*given: object) -> None:
        if given[4]:
            raise torch.OutOfMemoryError(said) if "CUDA" in said else RuntimeError(said)
        fill(*given)

    def counted(*given: object) -> None:
        starts.append(given[4])
        fill(*given)

    monkeypatch.setattr(restorers, "fill_classical", exhausted)
    words = restore_words(source, target, "moment")
    assert main(words) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert f"memory is exhausted ({said}); give a smaller --memory, which may start again; or free some" in told
    monkeypatch.setattr(restorers, "fill_classical", counted)
    assert main([*words, "--memory", "1GB"]) == 0
    assert starts == [4, 8]
    assert sorted(os.listdir(tmp_path)) == ["codes.npy", "r.json", "r.npy"]


def test_exhausted_memory_in_the_first_block_leaves_nothing(tmp_path):
    def fill(*given: object) -> None:
        raise MemoryError

    with pytest.raises(MemoryError):
        restore_to_file(random_codes(), replace(restorer("moment"), fill=fill), tmp_path / "r.npy")
    assert list(tmp_path.iterdir()) == []


def test_the_device_is_stated_and_may_change(tmp_path, blocks_of_four):
    codes = random_codes()
    moment = restorer("moment")
    interrupted(codes, moment, tmp_path / "r.npy")
    assert json.loads((tmp_path / "r.npy.part.json").read_text())["device"] == "cpu"
    assert resumed(codes, replace(moment, device="cuda"), tmp_path / "r.npy") == ([4, 8], [])
    told = json.loads((tmp_path / "r.json").read_text())
    assert (told["device"], told["look_ahead"]) == ("cuda", 5)


def test_a_writer_killed_between_the_two_renames_is_finished_by_the_same_command(tmp_path, monkeypatch, capsys):
    source = array_file(tmp_path)
    target = tmp_path / "r.npy"
    words = restore_words(source, target, "moment")
    assert main(words) == 0
    held = (tmp_path / "r.json").read_bytes()
    monkeypatch.setattr(restorers, "fill_classical", None)  # nothing is restored again
    for again, code in ((words, 0), (restore_words(source, target, "naive"), 2)):
        (tmp_path / "r.json").rename(tmp_path / "r.npy.part.json")
        assert main(again) == code
        assert sorted(os.listdir(tmp_path)) == ["codes.npy", "r.json", "r.npy"]
        assert (tmp_path / "r.json").read_bytes() == held
    assert "r.npy: exists; name another, or replace it with --force" in capsys.readouterr().err


# One writer


def test_a_second_writer_is_refused_however_it_spells_the_name(tmp_path, monkeypatch):
    (tmp_path / "out").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "out")
    (tmp_path / "alias.npy").symlink_to(tmp_path / "out/r.npy")
    monkeypatch.chdir(tmp_path)
    codes = random_codes()
    moment = restorer("moment")
    tried: list[str] = []

    def fill(codes: Codes, out: Array, first: int, progress: object) -> None:
        for name in ("out/r.npy", str(tmp_path / "out/r.npy"), "link/r.npy", "out/../out/r.npy", "alias.npy"):
            with pytest.raises(ValueError, match=r"r\.npy: another process is writing this video; wait for it"):
                restore_to_file(codes, restorer("naive"), Path(name))
            tried.append(name)
        moment.fill(codes, out, first, None)

    restore_to_file(codes, replace(moment, fill=fill), Path("out/r.npy"))
    assert len(tried) == 5
    np.testing.assert_array_equal(np.load("out/r.npy"), moment.restore(codes))
    restore_to_file(codes, restorer("naive"), Path("alias.npy"))  # a link is followed, and free again
    assert Path("alias.npy").is_symlink()
    np.testing.assert_array_equal(np.load("out/r.npy"), restorer("naive").restore(codes))
    assert sorted(os.listdir("out")) == ["r.json", "r.npy"]


def test_many_writers_of_one_video(tmp_path):
    """Eight processes, two methods, one name: one writes, the others are refused, and the json names its method."""
    codes = random_codes(frames=60, height=40, width=50)
    (tmp_path / "link").symlink_to(tmp_path)

    def write(number: int) -> None:
        name = ("naive", "moment")[number % 2]
        path = (tmp_path / "r.npy", tmp_path / "link" / "r.npy")[number // 2 % 2]
        try:
            restore_to_file(codes, restorer(name), path, force=False)
        except (ValueError, FileExistsError) as error:
            said = str(error)
        else:
            said = f"wrote {name}"
        (tmp_path / f"said{number}").write_text(said)

    for _ in range(4):
        children = [forked(lambda number=number: write(number)) for number in range(8)]
        assert [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children] == [0] * 8
        said = [(tmp_path / f"said{number}").read_text() for number in range(8)]
        wrote = [text for text in said if text.startswith("wrote")]
        assert len(wrote) == 1
        assert all("another process is writing" in text or "exists; name" in text for text in said if text != wrote[0])
        method = json.loads((tmp_path / "r.json").read_text())["method"]
        assert wrote == [f"wrote {method}"]
        np.testing.assert_array_equal(np.load(tmp_path / "r.npy"), restorer(method).restore(codes))
        assert sorted(file.name for file in tmp_path.glob("r.*")) == ["r.json", "r.npy"]
        (tmp_path / "r.npy").unlink()
        (tmp_path / "r.json").unlink()


def test_force_replaces_restored_video_only(tmp_path, make_clip, capsys):
    """Not a stream, whose json lies where the video's would, not the array that is being restored, nor another."""
    made, _ = sense(make_clip(frames=3), Sensing("quiver-physical", bits=3, ppp=3.25, name="mine"))
    stream = tmp_path / "mine.npy"
    for suffix in (".npy", ".json"):
        shutil.copy(made.path.with_suffix(suffix), stream.with_suffix(suffix))
    np.save(tmp_path / "a.npy", random_codes().read(0, 10))
    np.save(tmp_path / "cube.npy", random_codes(seed=1).read(0, 10))
    own = (stream, stream.with_suffix(".json"), made.path, tmp_path / "a.npy", tmp_path / "cube.npy")
    held = {path: path.read_bytes() for path in own}
    words = ["--method", "naive", "--force"]
    assert main(["restore", str(stream), "-o", str(stream), *words]) == 2
    assert "does not describe restored video" in capsys.readouterr().err
    assert main(["restore", str(made.path), "-o", str(made.path), *words]) == 2
    assert "which holds nothing else; name another place" in capsys.readouterr().err
    array = ["restore", str(tmp_path / "a.npy"), "--sensor", "quiver-paper"]
    assert main([*array, "-o", str(tmp_path / "." / "a.npy"), *words]) == 2
    assert "would be replaced by what is made from it" in capsys.readouterr().err
    assert main([*array, "-o", str(tmp_path / "cube.npy"), *words]) == 2
    assert "cube.npy: has no .json that describes restored video" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in held} == held
    assert [path.name for path in tmp_path.glob("cube.*")] == ["cube.npy"]
    (tmp_path / "d.npy").mkdir()
    assert main([*array, "-o", str(tmp_path / "d.npy"), *words]) == 2
    assert "d.npy: is a folder" in capsys.readouterr().err


# A full disk


@pytest.fixture(params=["posix_fallocate", "zeros"])
def reserving(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reserve disk space as on Linux, or as on macOS, which has no posix_fallocate: in pieces of 1000 bytes."""
    if request.param == "zeros":
        monkeypatch.delattr(os, "posix_fallocate", raising=False)
        monkeypatch.setattr(restored_file, "ZEROS", 1000)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    mount = tmp_path / "tmpfs"
    mount.mkdir()
    tried = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(mount)], capture_output=True)
    if tried.returncode:
        pytest.skip("a tmpfs may not be mounted here; a limit on the file's size is tested in any case")
    yield mount
    subprocess.run(["umount", str(mount)], check=True)


def array_file(folder: Path, shape: tuple[int, int, int] = (9, 24, 31)) -> Path:
    np.save(folder / "codes.npy", np.random.default_rng(0).integers(0, 8, shape, dtype=np.uint8))
    return folder / "codes.npy"


def restore_words(source: Path, target: Path, method: str) -> list[str]:
    return ["restore", str(source), "-o", str(target), "--method", method, "--sensor", "quiver-paper", "-q"]


def test_a_disk_that_fills_up(small_disk, tmp_path, capsys, reserving):
    """A disk of every number of pages up to one that holds all: one line and nothing left, or the complete video."""
    source = array_file(tmp_path)
    words = restore_words(source, small_disk / "r.npy", "moment")
    whole = []
    for kilobytes in range(4, 64, 4):
        subprocess.run(["mount", "-o", f"remount,size={kilobytes}k", str(small_disk)], check=True)
        code = main(words)
        said = capsys.readouterr().err
        names = sorted(os.listdir(small_disk))
        whole.append(code == 0)
        if code == 0:
            assert names == ["r.json", "r.npy"]
            for name in names:
                (small_disk / name).unlink()
        else:
            assert (code, said.count("\n"), names) == (2, 1, [])
            assert "No space left on device" in said
    assert whole == sorted(whole)  # once it fits, it fits
    assert not whole[6]  # 28 kB hold the 26.8 kB of video and no description
    assert whole[-1]


def test_a_file_that_may_not_grow(tmp_path, capsys, reserving):
    """RLIMIT_FSIZE at the header, in the middle, a byte short and just enough: no signal, one line or the video."""
    source = array_file(tmp_path)
    size = 128 + 4 * 9 * 24 * 31
    target = tmp_path / "out" / "r.npy"
    for limit in (0, 100, 128, size // 2, size - 1, size):

        def limited(limit: int = limit) -> None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
            assert main(restore_words(source, target, "moment")) == (0 if limit == size else 2)

        assert os.waitstatus_to_exitcode(os.waitpid(forked(limited), 0)[1]) == 0, limit
        assert sorted(os.listdir(tmp_path / "out")) == (["r.json", "r.npy"] if limit == size else []), limit
