"""Repair: every damaged file is named, and only what is damaged is made again; links are not replaced."""

from pathlib import Path

import numpy as np
import pytest
from fakes import (
    HERE,
    RECIPE,
    SMALL,
    damage,
    fail_on_tumble,
    make,
    moved,
    problems_of,
    tree,
)

from qsim.dataset import recipe
from qsim.dataset.dataset import Dataset
from qsim.dataset.generation import Options, generate
from qsim.streams.sensing import Sensing
from qsim.streams.storing import sense

SENSOR = """[sensor]
model = "BinarySPAD"
pde = 0.5
dark_count_rate = 200.0
bits = 3
[defects]
prnu = 0.1
dead_map = "bad.npy"
"""


@pytest.mark.parametrize("kind", ["missing", "truncated", "bit-flipped"])
def test_every_damaged_file_is_named_and_only_it_is_made_again(
    tmp_path: Path, undisturbed: dict[str, bytes], kind: str
):
    folder = tmp_path / "d"
    generate(SMALL, folder, HERE, make=make)
    for name in undisturbed:
        damage(folder / name, kind)
        # a clip without record does not count as made
        named = name.replace("jobs/", "clips/").removesuffix(".json") if kind == "missing" and "jobs" in name else name
        assert any(f"{folder / named}: " in problem for problem in problems_of(folder)), name
        kept = {path: path.stat().st_ino for path in folder.glob("clips/*") if path.name not in name}
        summary = generate(SMALL, folder, Options(workers=0, repair=True), make=make)
        assert summary.made == (name != "dataset.json"), name
        assert tree(folder) == undisturbed, name
        assert kept == {path: path.stat().st_ino for path in kept}


def test_a_damaged_record_costs_no_rendering_but_vouches_for_nothing(tmp_path: Path, undisturbed: dict[str, bytes]):
    """Its clip stays if its record would match the manifest, and is replaced if its clip.json has changed too."""
    folder = tmp_path / "d"
    generate(SMALL, folder, HERE, make=make)
    damage(folder / "jobs" / "tumble_0004.json", "bit-flipped")
    summary = generate(SMALL, folder, Options(workers=0, repair=True), make=fail_on_tumble)
    assert summary.made == 1
    damage(folder / "jobs" / "tumble_0004.json", "bit-flipped")
    about = folder / "clips" / "tumble_0004" / "clip.json"
    about.write_text(about.read_text().replace('"exposure": 0.0005', '"exposure": 0.0004'))
    summary = generate(SMALL, folder, Options(workers=0, repair=True), make=make)
    assert (summary.made, tree(folder)) == (1, undisturbed)


def test_repair_names_the_streams_that_go_with_a_clip(tmp_path: Path):
    """A stream added by `qsim sense` is in no recipe, so a repair cannot make it again."""
    folder = tmp_path / "d"
    generate(SMALL, folder, HERE, make=make)
    for damaged in ("radiance/000000.exr", "streams/own.npy"):
        drawn, _ = sense(Dataset.open(folder).clips()[0], Sensing("quiver-physical", bits=2, name="own"))
        damage(drawn.path.parents[1] / damaged, "bit-flipped")
        repaired = generate(SMALL, folder, Options(workers=0, repair=True), make=make).repaired
        assert f"{drawn.path}: was added by `qsim sense` and is gone; sense it again" in repaired
        assert not drawn.path.exists()
        assert problems_of(folder) == []


def test_repair_leaves_a_clip_with_files_of_yours(tmp_path: Path):
    """It deleted them; it is refused before anything is deleted."""
    folder = tmp_path / "d"
    again = Options(workers=0, repair=True)
    generate(SMALL, folder, HERE, make=make)
    note = folder / "clips" / "tumble_0004" / "notes.txt"
    note.write_text("mine")
    for name in ("fan_0000", "tumble_0004"):
        damage(folder / "clips" / name / "radiance" / "000000.exr", "bit-flipped")
    with pytest.raises(FileExistsError, match=r"notes\.txt: was not made by this program, which replaces only what it"):
        generate(SMALL, folder, again, make=make)
    assert note.read_text() == "mine"
    assert len(list(folder.glob("jobs/*.json"))) == 3
    note.unlink()
    assert generate(SMALL, folder, again, make=make).made == 2
    assert problems_of(folder) == []


def test_repair_does_not_take_the_clips_of_another_recipe(tmp_path: Path):
    folder = tmp_path / "d"
    generate(SMALL, folder, HERE, make=make)
    before = tree(folder)
    other = recipe.parse(RECIPE.replace("frames = 3", "frames = 4").replace("frames = 2", "frames = 3"))
    for kind in ("bit-flipped", "missing"):
        damage(folder / "dataset.json", kind)
        with pytest.raises(ValueError, match="none of its 3 finished clips is of this recipe"):
            generate(other, folder, Options(workers=0, repair=True), make=make)
    assert {name: content for name, content in before.items() if name != "dataset.json"} == tree(folder)


def test_repairing_a_stream_does_not_render(tmp_path: Path, undisturbed: dict[str, bytes]):
    folder = tmp_path / "d"
    generate(SMALL, folder, HERE, make=make)
    damage(next((folder / "clips" / "fan_0001" / "streams").glob("*.npy")), "bit-flipped")
    summary = generate(SMALL, folder, Options(workers=0, repair=True), make=fail_on_tumble)
    assert (summary.made, len(summary.repaired)) == (1, 1)
    assert "rendering" not in (folder / "logs" / "fan_0001.log").read_text().split("done on")[1]
    assert tree(folder) == undisturbed


def test_a_clip_that_was_moved_and_linked(tmp_path: Path):
    """It is read and its streams are repaired through the link; a repair that needs a new clip is refused."""
    wanted = recipe.parse(RECIPE)
    folder = tmp_path / "d"
    place = tmp_path / "disk2"
    generate(wanted, folder, HERE, make=make)
    expected = tree(folder)
    link = moved(folder, "fan_0000", place)
    assert generate(wanted, folder, Options(workers=0, repair=True), make=make).repaired == ()
    codes = next(place.glob("streams/*.npy"))
    codes.write_bytes(b"damaged")
    assert generate(wanted, folder, Options(workers=0, repair=True), make=make).made == 1
    assert link.is_symlink()
    assert Dataset.open(folder).verify() == []
    frame = next(place.glob("radiance/*.exr"))
    whole = frame.read_bytes()
    frame.write_bytes(b"damaged")
    for again in ({"repair": True}, {"repair": True, "retry": True}):
        with pytest.raises(ValueError, match=r"fan_0000 is a symbolic link to .*disk2, and repair=True replaces"):
            generate(wanted, folder, Options(workers=0, **again), make=make)
        assert link.is_symlink()
        assert frame.read_bytes() == b"damaged"
    assert generate(wanted, folder, HERE, make=make).failed == {}
    frame.write_bytes(whole)
    assert Dataset.open(folder).verify() == []
    frame.unlink()
    link.unlink()  # the advice of the message: the clip is made here
    assert generate(wanted, folder, Options(workers=0, repair=True), make=make).failed == {}
    assert tree(folder) == expected


def test_the_folder_of_the_recipe_may_move(tmp_path: Path):
    """Streams of a sensor's file, with a measured map, are kept beside one that is made again."""
    place = tmp_path / "a"
    folder = tmp_path / "d"
    place.mkdir()
    np.save(place / "bad.npy", np.eye(8, 10) > 0)
    (place / "my.toml").write_text(SENSOR)
    own = RECIPE.replace("quiver-physical", "my.toml").replace("bits = [1, 3]\nppp = 3.25", "ppp = [2, 4]")
    (place / "r.toml").write_text(own)
    generate(recipe.load(place / "r.toml"), folder, HERE, make=make)
    kept, damaged = (folder / "clips" / "fan_0000" / "streams" / f"my_{level}ppp.npy" for level in (2, 4))
    before = (kept.stat().st_ino, damaged.read_bytes())
    damage(damaged, "bit-flipped")
    place.rename(tmp_path / "b")
    summary = generate(recipe.load(tmp_path / "b" / "r.toml"), folder, Options(workers=0, repair=True), make=make)
    assert (summary.failed, summary.made) == ({}, 1)
    assert (kept.stat().st_ino, damaged.read_bytes()) == before
    np.save(tmp_path / "b" / "bad.npy", np.eye(8, 10) < 1)
    clip = Dataset.open(folder).clips()[0]
    with pytest.raises(FileExistsError, match=r"my_2ppp\.json: exists with other settings"):
        sense(clip, Sensing(str(tmp_path / "b" / "my.toml"), ppp=2))
