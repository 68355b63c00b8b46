"""What --force may delete: what the program made. Names in files are no way out of the output folder."""

import contextlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import fakes
import numpy as np
import pytest
from clips import write_clip

import quiver.cli.program
from qsim import descriptions, files
from qsim.cli.program import main
from qsim.dataset import generation, recipe
from qsim.dataset.dataset import Dataset
from qsim.formats import exporting
from qsim.formats.exporting import Export
from qsim.streams.clip import Clip
from qsim.streams.sensing import Sensing
from qsim.streams.storing import sense

QUICK = ["../../../victim", "/etc/victim", {}]
SLOW = ["..", ".", "", "a/b", "a\nb", "-x", "a\0b", "x" * 5000, "ü", "a b", "~", 7, None, []]
HOSTILE = [*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)]


@pytest.fixture
def data(tmp_path: Path) -> Path:
    (tmp_path / "r.toml").write_text(fakes.RECIPE.replace("seeds = [0, 1]", "seeds = [0]"))
    generation.generate(
        recipe.load(tmp_path / "r.toml"), tmp_path / "data", generation.Options(workers=0), make=fakes.make
    )
    (tmp_path / "victim").mkdir()
    (tmp_path / "victim" / "precious").write_text("mine")
    return tmp_path / "data"


def outside(folder: Path) -> dict[str, bytes]:
    """What lies beside the data set and the outputs."""
    kept = {
        path for path in folder.rglob("*") if path.is_file() and path.relative_to(folder).parts[0] not in ("data", "o")
    }
    return {str(path): path.read_bytes() for path in kept}


def rewritten(path: Path, change: Callable[[dict], object]) -> None:
    """A description with a change and the right checksum, as an attacker writes it."""
    found = files.read_json(path)
    change(found)
    descriptions.write_values(path, found)


@pytest.mark.parametrize("name", HOSTILE, ids=lambda name: repr(name)[:12])
def test_hostile_names_and_splits_leave_the_output_folder_alone(
    data: Path, name: object, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """In every place that becomes a path: names and splits of clips, series, records and streams."""
    monkeypatch.chdir(data.parent)
    manifest = data / "dataset.json"
    about = data / "clips" / "fan_0000" / "clip.json"
    record = data / "jobs" / "fan_0000.json"

    def streams(found: dict) -> None:
        found["streams"] = [str(name)]

    attacks = [
        (about, lambda found: found.update(name=name)),
        (about, lambda found: found.update(split=name)),
        (manifest, lambda found: found["scenes"][0].update(stem=name)),
        (manifest, lambda found: found["scenes"][0].update(split=name)),
        (manifest, lambda found: found["scenes"][0].update(seeds=name)),
        (record, streams),
    ]
    commands = [
        *(f"qsim convert data o/{kind} --to {kind} --force" for kind in ("png", "exr", "zarr", "mp4")),
        "qsim convert data/clips/fan_0000 o/one --to png --force",
        "qsim check data",
        "qsim sense data --ppp 1 --bits 2",
    ]
    wanted = recipe.load(data.parent / "r.toml")
    repair = generation.Options(workers=0, repair=True)
    before = outside(data.parent)
    content = {path: path.read_bytes() for path in (manifest, about, record)}
    for path, change in attacks:
        rewritten(path, change)
        for line in commands[:: 1 if path == about else 3]:
            assert main(line.split()[1:]) in (0, 1, 2), (path.name, line)
            err = capsys.readouterr().err
            assert "Traceback" not in err
            assert outside(data.parent) == before, (path.name, line)
        with contextlib.suppress(ValueError, OSError):
            generation.generate(wanted, data, repair, make=fakes.make)
        assert outside(data.parent) == before, (path.name, "repair")
        for file, whole in content.items():
            file.write_bytes(whole)
        shutil.rmtree(data / "failed", ignore_errors=True)
    assert sorted(path.name for path in data.parent.iterdir()) in (
        ["data", "o", "r.toml", "victim"],
        ["data", "r.toml", "victim"],
    )


@pytest.mark.parametrize("kind", ["png", "exr", "zarr", "mp4", "cube"])
def test_an_export_replaces_only_an_export(tmp_path: Path, kind: str):
    clip = write_clip(tmp_path / "clip", frames=2, height=6, width=8)
    source = sense(clip, Sensing("spad-320x240", bits=1, ppp=1.0))[0] if kind == "cube" else clip
    target = tmp_path / "out"
    for place in (target, target.with_name("out.json")):
        if place.name.endswith("json") or (kind in ("mp4", "cube") and place == target):
            if kind not in ("mp4", "cube"):
                continue
            place.write_text("mine")
        elif kind in ("mp4", "cube"):
            continue
        else:
            place.mkdir()
            (place / "precious").write_text("mine")
        with pytest.raises(FileExistsError, match="was not written by"):
            exporting.export(source, target, Export(kind), force=True)
        if place.is_dir():
            (place / "meta.json").write_text('{"software": {"qsim": "0.1.0"}}')
            with pytest.raises(FileExistsError, match="precious: was not made by"):
                exporting.export(source, target, Export(kind), force=True)
            assert (place / "precious").read_text() == "mine"
            shutil.rmtree(place)
        else:
            assert place.read_text() == "mine"
            place.unlink()
    (tmp_path / "elsewhere").mkdir()
    target.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(FileExistsError, match="was not written by"):
        exporting.export(source, target, Export(kind), force=True)
    target.unlink()
    for force in (False, True, True):
        exporting.export(source, target, Export(kind), force=force)
    with pytest.raises(FileExistsError, match="force=True"):
        exporting.export(source, target, Export(kind))


@pytest.mark.parametrize("stranger", ["notes.txt", "radiance/notes.txt", "streams/a.toml", "radiance/000000.exr.bak"])
def test_a_clip_with_a_file_of_yours_is_not_replaced(tmp_path: Path, stranger: str):
    clip = write_clip(tmp_path / "clip", frames=2, height=6, width=8)
    sense(clip, Sensing("quiver-physical", bits=2, ppp=1.0))
    np.save(tmp_path / "light.npy", np.ones((2, 6, 8), np.float32))
    line = [
        "convert",
        str(tmp_path / "light.npy"),
        str(clip.path),
        "--frame-rate",
        "9",
        "--transfer",
        "linear",
        "--force",
    ]
    (clip.path / stranger).write_text("mine")
    assert main(line) == 2
    assert (clip.path / stranger).read_text() == "mine"
    assert Clip.open(clip.path).verify() == []
    (clip.path / stranger).unlink()
    assert main(line) == 0
    assert not Clip.open(clip.path).streams


@pytest.mark.filterwarnings("ignore:.*validating on training clips")
def test_training_and_evaluation_replace_only_their_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    write_clip(tmp_path / "clip", frames=14, height=36, width=44)
    for command, mark in (
        (f"train {tmp_path / 'clip'} --steps 1 --crop 32", "settings.json"),
        (f"evaluate {tmp_path / 'clip'} --methods naive --ppp 1", "plan.json"),
    ):
        folder = tmp_path / mark.removesuffix(".json")
        folder.mkdir()
        (folder / mark).write_text("{}")
        (folder / "extensions.json").write_text("mine")
        assert quiver.cli.program.main([*command.split(), "-o", str(folder), "--force"]) == 2
        assert "extensions.json: was not made by this program" in capsys.readouterr().err
        assert {path.name for path in folder.iterdir()} - {"lock"} == {mark, "extensions.json"}


def test_an_import_replaces_only_a_stream(tmp_path: Path):
    np.save(tmp_path / "codes.npy", np.zeros((2, 6, 8), np.uint8))
    np.save(tmp_path / "mine.npy", np.ones(3))
    line = [
        "convert",
        str(tmp_path / "codes.npy"),
        str(tmp_path / "mine"),
        "--layout",
        "codes",
        "--bits",
        "3",
        "--frame-rate",
        "9",
        "--force",
    ]
    for described in (None, {"frame_rate": 9}):
        if described is not None:
            (tmp_path / "mine.json").write_text(json.dumps(described))
        assert main(line) == 2
        np.testing.assert_array_equal(np.load(tmp_path / "mine.npy"), np.ones(3))
    (tmp_path / "mine.npy").unlink()
    (tmp_path / "mine.json").unlink()
    assert [main(line), main(line)] == [0, 0]


def test_names_in_a_data_set_are_names(data: Path):
    assert Dataset.open(data).names() == ["fan_0000", "tumble_0004"]
