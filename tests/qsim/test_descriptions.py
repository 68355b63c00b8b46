"""Descriptions: a changed digit is found, a hostile value is refused in one line, and bombs do not go off."""

import json
import random
import shutil
import tomllib
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fakes
import numpy as np
import pytest
from clips import write_clip
from mutations import at, places, replaced

from qsim import descriptions, files
from qsim.cli.program import main
from qsim.dataset import checking, generation, recipe
from qsim.dataset.dataset import Dataset
from qsim.formats import exporting, importing
from qsim.formats.exporting import Export
from qsim.formats.recording import Hints
from qsim.report import report, views
from qsim.restored_video import RestoredInfo
from qsim.streams.clip import Clip
from qsim.streams.sensing import Sensing
from qsim.streams.storing import replay, sense
from qsim.streams.stream import Stream
from quiver.data import codes as data
from quiver.restoration.restored_file import restore_to_file
from quiver.restoration.restorers import restorer

BOMBS = {  # text of a value -> words of the answer
    "[" * 5000 + "]" * 5000: "nested more than 64 levels deep",
    "[" * 80 + "]" * 80: "nested more than 64 levels deep",
    "9" * 5000: "a whole number of more than 64 bits",
    "1" + "0" * 400: "a whole number of more than 64 bits",
}


@pytest.mark.parametrize(("bomb", "words"), BOMBS.items(), ids=["deep", "81 levels", "5000 digits", "400 digits"])
def test_deep_and_large_values_are_one_line_with_the_place(tmp_path: Path, bomb: str, words: str):
    toml = tmp_path / "a.toml"
    description = tmp_path / "a.json"
    toml.write_text(f"[recipe]\nname = {bomb}\n")
    description.write_text(f'{{"a": 1,\n "b": {bomb}}}')
    for read in (lambda: recipe.load(toml), lambda: files.read_toml(toml, "file")):
        with pytest.raises(ValueError, match=words) as caught:
            read()
        assert str(caught.value).startswith(f"{toml}:2: ")
        assert len(str(caught.value)) < 200 + len(str(toml))
    with pytest.raises(ValueError, match=f"{words} in line 2") as caught:
        files.read_json(description)
    assert str(caught.value).startswith(f"{description}: ")
    assert len(str(caught.value)) < 200 + len(str(description))


@pytest.mark.parametrize("key", ["a." * 50_000 + "a", ".".join(['"a"'] * 50_000)], ids=["bare", "quoted"])
@pytest.mark.parametrize("form", ["{} = 1", "[{}]"])
def test_dotted_keys_are_no_bomb_either(tmp_path: Path, key: str, form: str):
    """The parser takes quadratic time and memory for them: so they never reach it."""
    (tmp_path / "a.toml").write_text("x = 1\n" + form.format(key))
    with pytest.raises(ValueError, match=r"a\.toml:2: not valid TOML: nested more than 64 levels deep"):
        files.read_toml(tmp_path / "a.toml", "file")


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999"])
def test_json_holds_finite_numbers(tmp_path: Path, number: str):
    (tmp_path / "a.json").write_text(f'{{"a": [1, {number}]}}')
    with pytest.raises(ValueError, match=r"a\.json: not readable as JSON \(.*\); the file is damaged"):
        files.read_json(tmp_path / "a.json")
    (tmp_path / "a.json").write_text('{"a": [1, 18446744073709551615, -1e308]}')
    assert files.read_json(tmp_path / "a.json") == {"a": [1, 2**64 - 1, -1e308]}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A clip with a stream, a data set with one that `qsim sense` added, a stream beside no clip, restored video."""
    folder = tmp_path_factory.mktemp("made")
    clip = write_clip(folder / "clip", frames=3, height=6, width=8, split="val", flow=np.zeros((2, 6, 8)))
    sense(clip, Sensing("spcm20a", ppp=40.0, slices=3, name="counts"))
    (folder / "r.toml").write_text(fakes.RECIPE)
    generation.generate(recipe.load(folder / "r.toml"), folder / "data", generation.Options(workers=0), make=fakes.make)
    sense(Clip.open(folder / "data" / "clips" / "fan_0000"), Sensing("quiver-physical", bits=2, ppp=26.0))
    np.save(folder / "codes.npy", np.arange(96, dtype=np.uint8).reshape(2, 6, 8) % 8)
    recording = importing.read(folder / "codes.npy", Hints("codes", bits=3))
    importing.to_stream(recording, folder / "capture", importing.Import(1000.0))
    (folder / "codes.npy").unlink()
    restore_to_file(data.stream_codes(clip.stream("counts")), restorer("moment"), folder / "video.npy")
    return folder


def described(folder: Path) -> list[tuple[Path, Path]]:
    """(description, what `qsim check` is asked to look at)."""
    found = [(path, folder / "data") for path in sorted((folder / "data").rglob("*.json"))]
    found = [pair for pair in found if "fan_0001" not in str(pair[0]) and "tumble" not in str(pair[0])]
    found += [(path, folder / "clip") for path in sorted((folder / "clip").rglob("*.json"))]
    return [*found, (folder / "capture.json", folder / "capture.npy"), (folder / "video.json", folder / "video.npy")]


def numbers(value: Any) -> list[tuple[Any, ...]]:
    return [place for place in places(value) if type(at(value, place)) in (int, float)]


def test_every_changed_number_is_found(made: Path):
    """Each number of each description, made a tenth larger (a whole one by one)."""
    tried = 0
    for description, whole in described(made):
        before = description.read_bytes()
        found = json.loads(before)
        for place in numbers(found):
            value = at(found, place)
            if place in (("format_version",),):
                continue  # refused with both numbers: test_clip.py
            description.write_bytes(files.to_json(replaced(found, place, value * 1.1 if value % 1 else value + 1)))
            try:
                said = checking.check(whole)
            except ValueError as error:  # of dataset.json: exit code 2
                said = [str(error)]
            assert any(line.startswith(f"{description}: ") for line in said), (description, place, said)
            tried += 1
        description.write_bytes(before)
    assert main(["check", *{str(whole) for _, whole in described(made)}]) == 0
    assert tried > 60


HOSTILE: list[Any] = [
    *(None, True, "", "x", "../../x", [], {}, [1], [[1]], {"a": 1}, {"a": None}, [None], "0" * 64),
    *(0, 1, -1, 2, 7, 0.5, -0.5, 2**31, 2**63, 2**64 - 1, 1e-300, 1e300, -1e300, 1e30, 1e-30, 1e-9),
]


def use_clip(folder: Path) -> None:
    """Every reader of the description of a clip and of its stream."""
    clip = Clip.open(folder / "clip")
    assert repr(clip)
    last = len(clip) - 1
    for read in (clip.radiance, clip.sharp, clip.flow, clip.flow_back, clip.valid):
        read(last)
    stream = clip.stream("counts")
    assert repr(stream)
    stream.codes(0, 1)
    replay(clip, stream, 0)
    sense(clip, Sensing("quiver-physical", bits=2, ppp=1.0, name="new"), force=True)
    exporting.export(clip, folder / "out", Export("exr"), force=True)
    codes, _ = data.stored(clip, "new")
    restorer("moment").restore(codes, 0, 1)


def use_report(folder: Path) -> None:
    report.build_page(folder / "clip")
    report.build_page(folder / "video.json")


def use_rest(folder: Path) -> None:
    """The same for the data set, the stream beside no clip, and restored video."""
    dataset = Dataset.open(folder / "data")
    assert repr(dataset)
    for clip in dataset.clips():
        clip.radiance(0)
    stream = Stream.open(folder / "capture.json")
    assert repr(stream)
    stream.codes(0, 1)
    assert stream.sensor.levels
    exporting.export(stream, folder / "png", Export("png"), force=True)
    data.open_stream(folder / "capture.npy")
    views.open_source(folder / "video.npy").views["values"].picture(0)
    data.open_stream(folder / "video.npy")


def use_check(folder: Path) -> None:
    for name in ("clip", "data", "capture.npy", "video.npy"):
        checking.check(folder / name)


def hostile_descriptions(made: Path, folder: Path, wanted: int | None, *uses: Callable[[Path], None]) -> int:
    """So many (or all) changes of one value in one description, sealed as an attacker would; the number refused."""
    victim = folder / "victim"
    shutil.copytree(made, victim)
    cases = [
        (path, place, value)
        for path, _ in described(victim)
        for place in places(files.read_json(path))
        for value in (*HOSTILE, "GONE")
        if place[0] not in ("checksum", "software")
    ]
    chosen = cases if wanted is None else random.Random(18).sample(cases, wanted)
    refused = 0
    for path, place, value in chosen:
        before = path.read_bytes()
        found = replaced(json.loads(before), place, value)
        if value == "GONE":
            inside = at(found, place[:-1])
            inside.pop(place[-1])
        descriptions.write_values(path, found)
        for use in (
            *uses,
            lambda folder: [checking.check(folder / name) for name in ("clip", "data", "capture.npy", "video.npy")],
        ):
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # of numbers that overflow
                    use(victim)
            except (ValueError, OSError) as error:
                refused += 1
                if "\n" in str(error) or len(str(error)) > 1000:
                    raise AssertionError(f"{path}: {place} = {value!r:.60}: more than a line: {error!r}") from error
            except Exception as error:
                raise AssertionError(f"{path}: {place} = {value!r:.60}: {error!r}") from error
        path.write_bytes(before)
    return refused


def test_a_value_of_another_kind_is_one_line(made: Path, tmp_path: Path):
    assert hostile_descriptions(made, tmp_path, 60, use_clip, use_rest) > 20


@pytest.mark.slow
def test_every_value_of_another_kind_is_one_line(made: Path, tmp_path: Path):
    hostile_descriptions(made, tmp_path, None, use_clip, use_rest)


@pytest.mark.slow
def test_reports_of_values_of_another_kind(made: Path, tmp_path: Path):
    hostile_descriptions(made, tmp_path, 400, use_report)


def test_a_byte_order_mark_is_skipped(tmp_path):
    """Some editors begin a text file with one."""
    toml = tmp_path / "a.toml"
    toml.write_text(fakes.RECIPE, encoding="utf-8-sig")
    assert files.read_toml(toml, "file") == tomllib.loads(fakes.RECIPE)
    assert [*recipe.load(toml).jobs] == [*recipe.parse(fakes.RECIPE, toml).jobs]


def test_what_no_reader_accepts_is_not_written(tmp_path: Path):
    video = RestoredInfo(method="moment", seconds_per_frame=0.1)
    object.__setattr__(video, "device", {"deep": 1 << 64})
    with pytest.raises(ValueError, match="a description would hold a whole number of more than 64 bits"):
        descriptions.write(tmp_path / "v.json", video)
    assert not list(tmp_path.iterdir())
