"""Submissions to the Single Photon Challenge: the zip's names and pictures, scores, and what --force replaces."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from quiver.cli.program import main
from quiver.data.challenge import cubes
from quiver.data.codes import Codes
from quiver.restoration import automatic, interface
from quiver.restoration.interface import Restorer
from quiver.restoration.restorers import restorer
from quiver.restoration.submission import picture_psnr, restore_cubes, restore_last

LEVELS = np.array([0.1, 0.5, 0.9])  # of white, in the three colours of a static cube


def static_cubes(folder: Path, planes: int = 1200, size: tuple[int, int] = (6, 11), truth: bool = True) -> Path:
    """Two scenes of one colour each, with the truth that they restore to."""
    rng = np.random.default_rng(4)
    for scene, levels in (("day", LEVELS), ("night", LEVELS / 10)):
        (folder / scene).mkdir(parents=True)
        fired = rng.random((planes, *size, 3)) < -np.expm1(-0.5 * levels)
        np.save(folder / scene / "000007.npy", np.packbits(fired, axis=2))
        (folder / scene / "meta.json").write_text(json.dumps({"width": size[1]}))
        if truth:
            colour = np.where(levels <= 0.0031308, 12.92 * levels, 1.055 * levels ** (1 / 2.4) - 0.055)
            picture = np.broadcast_to(np.rint(255 * colour).astype(np.uint8), (*size, 3))
            Image.fromarray(np.ascontiguousarray(picture)).save(folder / scene / "000007.png")
    return folder


def test_a_submission_holds_exactly_the_pictures(tmp_path, capsys):
    """One command: SCENE/FRAME.png of sRGB, near the light of the cubes, and their PSNR in the description."""
    source = static_cubes(tmp_path / "cubes")
    target = tmp_path / "new" / "out.zip"
    words = ["restore", str(source), "-o", str(target), "--method", "moment:9", "--planes", "127"]
    assert main(words) == 0
    assert "2 pictures by moment:9, 127 planes per code, PSNR" in capsys.readouterr().out
    meta = json.loads(target.with_suffix(".json").read_text())
    with zipfile.ZipFile(target) as archive:
        assert archive.namelist() == ["day/000007.png", "night/000007.png"]
        assert archive.testzip() is None
        for cube in cubes(source):
            with Image.open(io.BytesIO(archive.read(f"{cube.name}.png"))) as opened:
                assert (opened.format, opened.mode) == ("PNG", "RGB")
                made = np.asarray(opened)
            truth = cube.truth()
            assert truth is not None
            error = np.sqrt(np.mean((made.astype(float) - truth) ** 2))
            assert meta["psnr_of_pictures"][cube.name] == pytest.approx(20 * np.log10(255 / error))
            np.testing.assert_array_equal(made, restore_last(cube, restorer("moment:9"), 127))
    assert meta["psnr"] == pytest.approx(np.mean(list(meta["psnr_of_pictures"].values())))
    assert sorted(path.name for path in target.parent.iterdir()) == ["out.json", "out.zip"]
    first = target.read_bytes()
    assert main(words) == 2
    assert main([*words, "--force"]) == 0
    assert target.read_bytes() == first, "the same pictures make the same zip"


def test_restored_levels_are_those_of_the_cube(tmp_path):
    """The mean over pixels of a static cube is its level, within five deviations of 1143 planes of 66 pixels."""
    cube = cubes(static_cubes(tmp_path / "cubes"))[0]
    made = restore_last(cube, restorer("moment:9"), 127) / 255
    light = np.where(made <= 0.04045, made / 12.92, ((made + 0.055) / 1.055) ** 2.4).mean(axis=(0, 1))
    p = -np.expm1(-0.5 * LEVELS)
    spread = 2 * np.sqrt(p / (1 - p) / (9 * 127 * 66))
    bias = 2 * p / (1 - p) / 2 / (9 * 127) + 0.5 / 255 * 2.4  # curvature of the inverse, and rounding to 8 bits
    assert np.abs(light - LEVELS).max() < (5 * spread + bias).max()


def test_without_truth_there_is_no_score(tmp_path):
    found = cubes(static_cubes(tmp_path / "cubes", planes=3, truth=False))
    info = restore_cubes(found, restorer("naive"), 1, tmp_path / "a.zip")
    assert info.psnr is None
    assert info.psnr_of_pictures == {"day/000007": None, "night/000007": None}


def test_psnr_of_pictures():
    black = np.zeros((2, 3, 3), np.uint8)
    grey = np.full((2, 3, 3), 51, np.uint8)
    assert picture_psnr(black, grey) == pytest.approx(20 * np.log10(5))
    assert picture_psnr(grey, grey) == 100.0


def test_only_submissions_are_replaced(tmp_path, capsys):
    source = static_cubes(tmp_path / "cubes", planes=3)
    (tmp_path / "mine.zip").write_bytes(b"not yours")
    words = ["restore", str(source), "--method", "naive", "--force", "-o"]
    assert main([*words, str(tmp_path / "mine.zip")]) == 2
    assert "is not a submission with its .json" in capsys.readouterr().err
    assert (tmp_path / "mine.zip").read_bytes() == b"not yours"


def test_a_failure_leaves_no_zip(tmp_path, capsys):
    """The second truth has another size: one line, and nothing new."""
    source = static_cubes(tmp_path / "cubes", planes=3)
    Image.fromarray(np.zeros((6, 12, 3), np.uint8)).save(source / "night" / "000007.png")
    before = sorted(tmp_path.rglob("*"))
    assert main(["restore", str(source), "-o", str(tmp_path / "a.zip"), "--method", "naive"]) == 2
    assert "its cube needs RGB of 6 x 11" in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before


def test_a_damaged_truth_is_found_before_anything_is_restored(tmp_path):
    """The picture of the last of many cubes: it was read after the others had been restored, for hours."""
    source = static_cubes(tmp_path / "cubes", planes=3)
    (source / "night" / "000007.png").write_bytes(b"no picture")
    with pytest.raises(ValueError, match=r"night/000007\.png: not readable as PNG"):
        restore_cubes(cubes(source), Idle(), 1, tmp_path / "a.zip")


class Idle:
    """A method that is never asked."""

    name = "idle"


def test_every_band_of_every_cube_decides(tmp_path, monkeypatch, capsys):
    """`auto`, and --strict with the remark on the last band of the last cube."""
    source = static_cubes(tmp_path / "cubes", planes=21)
    seen = []
    unknown = {"night/000007 blue"}
    words = ["restore", str(source), "-o", str(tmp_path / "a.zip"), "--planes", "7"]

    def chosen(name: str, streams: Iterable[Codes], options: object) -> tuple[Restorer, None]:
        seen.extend(codes.name for codes in streams)
        return restorer("naive"), None

    def remark(name: str, scope: object, codes: Codes) -> str | None:
        return f"never measured so: {codes.name}" if codes.name in unknown else None

    with monkeypatch.context() as patched:
        patched.setattr(automatic, "chosen_for_all", chosen)
        assert main(words) == 0
    assert seen == [f"{scene}/000007 {colour}" for scene in ("day", "night") for colour in ("red", "green", "blue")]
    monkeypatch.setattr(interface, "remark", remark)
    assert main([*words, "--force", "--method", "mergenet", "--strict"]) == 2
    assert "never measured so: night/000007 blue; leave out --strict" in capsys.readouterr().err
    unknown |= {"day/000007 red", "night/000007 red"}
    assert main([*words, "--force", "--method", "mergenet"]) == 0
    told = capsys.readouterr().err
    assert told.count("never measured so") == 1
    assert "warning: 2 more lines of this kind" in told
