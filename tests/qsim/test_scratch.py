"""What killed writers left is deleted; what only looks like it, or is in use, stays."""

import json
import os
import shutil
import signal
import threading
from pathlib import Path

import numpy as np
import pytest
from forks import forked, in_child

from qsim import files, locks
from qsim.scratch import RECORD, Scratch, sweep


def killed_while_writing(path: Path) -> Path:
    """Return the scratch folder of a process that was killed while it replaced a file."""

    def write() -> None:
        with files.replacing(path) as file:
            file.write(b"half")
            os.kill(os.getpid(), signal.SIGKILL)

    os.waitpid(forked(write), 0)
    return next(item for item in path.parent.iterdir() if item.name.startswith(".qsim-"))


def test_a_killed_writer_is_swept_by_the_next(tmp_path: Path):
    (tmp_path / "a.json").write_text("before")
    left = killed_while_writing(tmp_path / "a.json")
    assert (left / "0").exists()
    sweep(tmp_path)
    assert os.listdir(tmp_path) == ["a.json"]
    assert (tmp_path / "a.json").read_text() == "before"


def killed_while_naming(folder: Path) -> None:
    """Leave the scratch folder of a process that was killed after it had named the first of three new files."""

    def write() -> None:
        rename = os.replace

        def once(new: Path, output: Path) -> None:
            rename(new, output)
            os.kill(os.getpid(), signal.SIGKILL)

        os.replace = once
        with files.replacing_together(*(folder / name for name in "abc")) as parts:
            for part in parts:
                part.write_text("new")

    os.waitpid(forked(write), 0)


@pytest.mark.parametrize("names", ["", "a", "abc"], ids=["new", "one", "all"])
def test_files_that_belong_together_are_named_together(tmp_path: Path, names: str):
    for name in names:
        (tmp_path / name).write_text("old")
    killed_while_naming(tmp_path)
    assert (tmp_path / "a").read_text() == "new"
    assert not (tmp_path / "c").exists()  # no description of what is not there
    sweep(tmp_path)
    assert sorted(os.listdir(tmp_path)) == ["a", "b", "c"]
    assert {(tmp_path / name).read_text() for name in "abc"} == {"new"}


def test_files_of_which_a_power_cut_lost_one_are_not_named(tmp_path: Path):
    killed_while_naming(tmp_path)
    (tmp_path / "a").unlink()
    sweep(tmp_path)
    assert os.listdir(tmp_path) == []


def test_a_file_that_somebody_put_there_meanwhile_stays(tmp_path: Path):
    killed_while_naming(tmp_path)
    (tmp_path / "b").write_text("precious")
    sweep(tmp_path)
    assert sorted(os.listdir(tmp_path)) == ["a", "b"]
    assert (tmp_path / "b").read_text() == "precious"


@pytest.mark.parametrize("name", ["../a", "/a", "x/a", ".."])
def test_a_record_names_only_files_beside_it(tmp_path: Path, name: str):
    place = tmp_path / "x"
    place.mkdir()
    killed_while_naming(place)
    (left,) = (item for item in place.iterdir() if item.name.startswith(".qsim-"))
    record = json.loads((left / RECORD).read_text())
    record["moves"] = [["0/b", name, []]]
    (left / RECORD).write_text(json.dumps(record))
    sweep(place)
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["a", "x"]


def disguises(left: Path) -> dict[str, Path]:
    """Return folders and links of a user that look like what a killed writer left, each with a precious file."""
    made = {}
    for name in ("copied", "no record", "wrong token", "more files", "linked"):
        made[name] = left.with_name(f".qsim-{len(made):032x}") if name != "more files" else left
        if name not in ("more files", "linked"):
            shutil.copytree(left, made[name])
    made["linked"].symlink_to(left)
    (made["no record"] / RECORD).unlink()
    (made["wrong token"] / RECORD).write_text(json.dumps({"software": "qsim", "token": "0" * 32}))
    (left / "precious").touch()
    return made


def test_what_only_looks_like_a_leftover_stays(tmp_path: Path):
    left = killed_while_writing(tmp_path / "a.json")
    made = disguises(left)
    for name in ("fan.tmp-2", "fan.removed-20260102", ".qsim-1", ".qsim-" + "g" * 32):
        (tmp_path / name).mkdir()
        (tmp_path / name / "precious").touch()
    before = sorted(tmp_path.rglob("*"))
    sweep(tmp_path)
    assert sorted(tmp_path.rglob("*")) == before, made


def test_a_living_writer_is_not_swept(tmp_path: Path):
    with files.replacing(tmp_path / "a.json") as file:
        file.write(b"whole")
        assert in_child(lambda: sweep(tmp_path), 10)
    assert (tmp_path / "a.json").read_bytes() == b"whole"
    assert os.listdir(tmp_path) == ["a.json"]


def test_a_replaced_folder_is_gone_and_its_neighbours_stay(tmp_path: Path):
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "a.removed-1").mkdir()
    files.remove_folder(tmp_path / "a")
    assert os.listdir(tmp_path) == ["a.removed-1"]


def test_an_error_names_the_output_and_leaves_nothing(tmp_path: Path):
    with pytest.raises(OSError) as caught, Scratch(tmp_path / "none" / "a.json"):
        pass
    assert caught.value.filename is not None
    with pytest.raises(FileNotFoundError) as caught, files.replacing(tmp_path / "none" / "a.json"):
        pass
    assert files.wording(caught.value) == f"{tmp_path / 'none' / 'a.json'}: No such file or directory"
    with pytest.raises(ZeroDivisionError), files.replacing(tmp_path / "a.json"):
        raise ZeroDivisionError
    assert os.listdir(tmp_path) == []


def test_a_pipe_or_a_device_is_no_output(tmp_path: Path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ValueError, match="is a pipe or a device"), files.replacing(tmp_path / "pipe"):
        pass
    several = files.replacing_together(tmp_path / "a.json", tmp_path / "pipe")
    with pytest.raises(ValueError, match="is a pipe or a device"), several:
        pass
    assert (tmp_path / "pipe").is_fifo()


@pytest.mark.parametrize("kind", ["file", "empty", "link", "pipe", "folder"])
def test_a_lock_takes_nobody_elses_name(tmp_path: Path, kind: str):
    """The name of a lock is known before: what somebody else put there is refused, not locked, written or deleted."""
    path = tmp_path / "r.npy.lock"
    precious = tmp_path / "precious"
    precious.write_bytes(locks.RECORD)
    match kind:
        case "file":
            path.write_bytes(b"precious")
        case "empty":
            path.touch()
        case "link":
            path.symlink_to(precious)
        case "pipe":
            os.mkfifo(path)
        case "folder":
            path.mkdir()
    before = os.lstat(path)
    lock = locks.Lock(path)
    with pytest.raises(FileExistsError, match="is not a lock of this program"):
        lock.acquire()
    lock.delete()
    assert os.lstat(path) == before
    assert np.frombuffer(precious.read_bytes(), np.uint8).size == len(locks.RECORD)


def test_an_interruption_between_two_names_gives_both(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Else the codes have no description, and the same command takes them for somebody else's."""
    replace = os.replace
    calls = []

    def interrupted(source: Path, target: Path) -> None:
        calls.append(target)
        if len(calls) == 2:
            raise KeyboardInterrupt
        replace(source, target)

    monkeypatch.setattr(os, "replace", interrupted)
    paths = (tmp_path / "a.npy", tmp_path / "a.json")

    def write() -> None:
        with files.replacing_described(*paths) as opened:
            for file in opened:
                file.write(b"new")

    with pytest.raises(KeyboardInterrupt):
        write()
    assert sorted(tmp_path.iterdir()) == sorted(paths)


def test_files_of_two_writers_never_mix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The second one names its files when the first has named all of its own."""
    names = tmp_path / "a.json", tmp_path / "a.toml"
    taken = threading.Event()
    rename = os.replace
    others: list[threading.Thread] = []

    def slow(source: Path, target: Path) -> None:
        rename(source, target)
        if not others:  # after the first name of the first writer
            others.append(threading.Thread(target=write, args=("second",)))
            others[0].start()
            assert not taken.wait(0.1)

    def write(who: str) -> None:
        with files.replacing_together(*names) as parts:
            for part in parts:
                part.write_text(who)
        if who == "second":
            taken.set()

    monkeypatch.setattr(os, "replace", slow)
    write("first")
    others[0].join(10)
    assert {name.read_text() for name in names} == {"second"}
