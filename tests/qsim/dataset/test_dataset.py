"""Data sets: reading, damage, versions, and assets shared between splits."""

import json
from pathlib import Path

import pytest
from fakes import (
    HERE,
    SMALL,
    make,
    problems_of,
    tree,
)

from qsim import descriptions, files
from qsim.dataset.checking import check
from qsim.dataset.dataset import Dataset
from qsim.dataset.generation import generate

ONE = "1f" * 32
TWO = "2f" * 32


def test_a_finished_data_set(tmp_path: Path):
    generate(SMALL, tmp_path / "d", HERE, make=make)
    found = Dataset.open(tmp_path / "d")
    assert [clip.name for clip in found.clips()] == ["fan_0000", "fan_0001", "tumble_0004"]
    assert [clip.name for clip in found.clips("test")] == ["tumble_0004"]
    assert len(found.clips("val")) == 0
    assert found.missing == found.verify() == []
    assert found.recipe.recipe.frames == 3
    clip = found.clips()[1]
    assert clip.streams == ("quiver-physical_1bit_3.25ppp", "quiver-physical_3bit_3.25ppp")
    assert clip.info.split == "train"
    assert clip.stream(clip.streams[1]).codes().shape == (3, 8, 10)
    with pytest.raises(ValueError, match="unknown split 'tset'"):
        found.clips("tset")


def test_no_flipped_bit_of_records_and_manifest_escapes(tmp_path: Path):
    """Every byte of one record, every seventh of the manifest: the file is named, however JSON reads the bit."""
    folder = tmp_path / "d"
    generate(SMALL, folder, HERE, make=make)
    for path, step in ((folder / "jobs" / "fan_0000.json", 1), (folder / "dataset.json", 7)):
        content = path.read_bytes()
        for at in range(0, len(content), step):
            flipped = bytearray(content)
            flipped[at] ^= 1 << at % 7
            path.write_bytes(flipped)
            assert any(str(path) in problem for problem in problems_of(folder)), (
                path.name,
                at,
                flipped[at - 5 : at + 5],
            )
        path.write_bytes(content)
    assert problems_of(folder) == []


def test_a_damaged_manifest_is_made_again(tmp_path: Path, undisturbed: dict[str, bytes]):
    generate(SMALL, tmp_path / "d", HERE, make=make)
    manifest = tmp_path / "d" / "dataset.json"
    manifest.write_text(manifest.read_text()[:100])
    with pytest.raises(ValueError, match=r"dataset\.json: not readable as JSON"):
        Dataset.open(tmp_path / "d")
    manifest.unlink()
    with pytest.raises(FileNotFoundError, match=r"dataset\.json: missing; `qsim generate"):
        check(tmp_path / "d")
    generate(SMALL, tmp_path / "d", HERE, make=make)
    assert tree(tmp_path / "d") == undisturbed


@pytest.mark.parametrize(("version", "advice"), [(2, "newer qsim"), (0, "make it again")])
def test_other_format_versions(tmp_path: Path, version: int, advice: str):
    generate(SMALL, tmp_path / "d", HERE, make=make)
    manifest = tmp_path / "d" / "dataset.json"
    manifest.write_text(json.dumps(json.loads(manifest.read_text()) | {"format_version": version}))
    for action in (lambda: Dataset.open(tmp_path / "d"), lambda: generate(SMALL, tmp_path / "d", HERE, make=make)):
        with pytest.raises(ValueError, match=f"format version {version}, this qsim reads version 1; .*{advice}"):
            action()


@pytest.mark.parametrize("asset", ["texture abc", "mesh abc"])
def test_what_training_sees_of_the_test_split_is_reported(tmp_path: Path, asset: str):
    generate(SMALL, tmp_path / "d", HERE, make=make)
    for name, assets in [("fan_0001", [asset, "mesh m"]), ("tumble_0004", ["mesh n", asset])]:
        path = tmp_path / "d" / "clips" / name / "clip.json"
        descriptions.write_values(path, files.read_json(path) | {"assets": assets})
    shared = generate(SMALL, tmp_path / "d", HERE, make=make).shared
    assert len(shared) == 1
    assert f"its {asset} is also in fan_0001, which is not a test clip" in shared[0]
    assert shared[0] in Dataset.open(tmp_path / "d").verify()


def test_files_that_scenes_of_both_kinds_read_are_reported_by_name(tmp_path: Path):
    """A mesh of a folder has another size in every body, and an XML scene has no bodies: their files were not compared.

    A pattern's digest covers names alone, and text is not an asset. A picture that is a photograph too is named once.
    """
    folder = tmp_path / "d"
    generate(SMALL, folder, HERE, make=make)
    for name, mesh, picture in [("fan_0001", "bunny.obj", "a.png"), ("tumble_0004", "/mine/HARE.OBJ", "b.png")]:
        path = folder / "clips" / name / "clip.json"
        reads = {
            mesh: ONE,
            picture: TWO,
            "*.obj": "3" * 64,
            "LICENCE.txt": "4" * 64,
            f"{name}.hdr": files.sha256(name.encode()),
        }
        descriptions.write_values(path, files.read_json(path) | {"assets": [f"photograph {TWO}"], "reads": reads})
    shared = generate(SMALL, folder, HERE, make=make).shared
    clip = folder / "clips" / "tumble_0004"
    named = (f"b.png (SHA-256 {TWO})", f"/mine/HARE.OBJ (SHA-256 {ONE})")
    assert shared == tuple(f"{clip}: its file {each} is also in fan_0001, which is not a test clip" for each in named)
    assert set(shared) <= set(Dataset.open(folder).verify())
