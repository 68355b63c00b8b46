"""Warped pictures: light and flow follow from the motion, and repeats give the same bytes and keep what is there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from qsim import files
from qsim.cli import warped_pictures
from qsim.formats.warped_pictures import (
    BRIGHTEST,
    FINE,
    LEAST_REPEAT,
    MOST_POINTS,
    MOST_REPEAT,
    SHAKE,
    Layer,
    Path2D,
    frame,
    layers,
)
from qsim.streams.clip import Clip
from quiver.data.clips import open_clips


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    """Two coloured pictures and a licence."""
    folder = tmp_path / "pictures"
    rng = np.random.default_rng(0)
    folder.mkdir()
    for name in ("a.png", "b.jpg"):
        soft = ndimage.gaussian_filter(rng.random((150, 170, 3)), (3, 3, 0))
        Image.fromarray(np.uint8(255 * (soft - soft.min()) / np.ptp(soft))).save(folder / name)
    (tmp_path / "licence.txt").write_text("CC0")
    return folder


def run(pictures: Path, out: Path, *words: object) -> int:
    licence = pictures.parent / "licence.txt"
    size = ["--frames", 5, "--height", 24, "--width", 30]
    return warped_pictures.main([str(w) for w in (pictures, "-o", out, "--licence", licence, *size, *words)])


def test_flow_leads_to_the_same_light():
    """Random smooth layers and motions up to 8 px/frame: light moves along the flow, where it stays in view."""
    rng = np.random.default_rng(1)
    soft = [ndimage.gaussian_filter(rng.random((300, 300)), 8, mode="wrap") * 3 for _ in range(2)]
    inside = 0
    for _ in range(8):
        parts = layers(soft, (60, 70), 8.0, rng, shake=0.5)
        time = float(rng.uniform(-4, 4))
        now, flow, valid = frame(parts, (60, 70), time)
        later = frame(parts, (60, 70), time + 1)[0]
        y, x = np.mgrid[:60, :70]
        there = ndimage.map_coordinates(later, [y + flow[1], x + flow[0]], order=1, mode="nearest")
        off = np.abs(there - now)[valid]
        assert np.median(off) < 0.01 * now.mean()  # pixels at edges of bodies mix two layers
        assert np.percentile(off, 75) < 0.05 * now.mean()
        inside += int(valid.sum())
    assert inside > 8 * 60 * 70 / 3


def test_a_shaking_camera_keeps_its_speed_and_changes_direction():
    """Two hundred cameras at 16 px/frame, layers at rest: no point moves twice as far as shake may, and no path with
    one velocity and one acceleration follows most of them.
    """
    rng = np.random.default_rng(4)
    flat = [np.ones((64, 64))]
    times = np.arange(-5.0, 6.0)
    path = np.stack([np.ones_like(times), times, times**2], axis=1)
    left = []
    for _ in range(200):
        camera = layers(flat, (30, 30), 16.0, rng, shake=1.0)[0].camera
        corners = np.array([[0, 0, 1], [0, 30, 1], [30, 0, 1], [30, 30, 1]]).T
        places = np.stack([(camera.matrix(t) @ corners)[:2].ravel() for t in times])
        assert np.abs(np.diff(places, axis=0)).max() < 2 * SHAKE * 16
        rest = places - path @ np.linalg.lstsq(path, places, rcond=None)[0]
        left.append(float(np.abs(rest).max()))
    assert np.median(left) > 0.5


def test_patterns_repeat(monkeypatch):
    """A background that is all pattern: some shift of at most MOST_REPEAT px along each axis gives the same light."""
    monkeypatch.setattr("qsim.formats.warped_pictures.POINTS", 0.0)
    rng = np.random.default_rng(5)
    soft = [rng.random((300, 300))]
    for _ in range(20):
        light = layers(soft, (30, 30), 0.0, rng, patterns=1.0)[0].light
        for axis in (0, 1):
            lines = np.moveaxis(light, axis, 0)
            assert any(
                np.array_equal(lines[n:], lines[:-n]) for n in range(FINE * LEAST_REPEAT - 1, FINE * MOST_REPEAT + 1)
            )
        assert np.ptp(light) > 0


def test_grids_lie_along_the_pixels(monkeypatch):
    """Still stripes and squares in the background have few tones; on turned or shifted ones edges cut pixels."""
    monkeypatch.setattr("qsim.formats.warped_pictures.POINTS", 0.0)
    monkeypatch.setattr("qsim.formats.warped_pictures.GRIDS", 1.0)
    monkeypatch.setattr("qsim.formats.warped_pictures.STRAIGHT", 1.0)
    rng = np.random.default_rng(7)
    for _ in range(30):
        behind = layers([rng.random((300, 300))], (24, 24), 0.0, rng, patterns=1.0)[0]
        light = frame([behind], (24, 24), 0.0)[0]
        assert len(np.unique(np.round(light, 6))) <= 16


def test_points_are_single_bright_pixels(monkeypatch):
    """Points of a layer fill squares of FINE texels, at most MOST_POINTS of them, and nothing else changes."""
    monkeypatch.setattr("qsim.formats.warped_pictures.POINTS", 1.0)
    rng = np.random.default_rng(8)
    for _ in range(20):
        light = layers([np.full((300, 300), 0.5)], (60, 60), 0.0, rng)[0].light
        points = light > np.median(light)
        squares = points.reshape(points.shape[0] // FINE, FINE, -1, FINE)
        assert 0 < squares.any((1, 3)).mean() < 1.5 * MOST_POINTS
        assert np.array_equal(squares.any((1, 3)), squares.all((1, 3)))
        assert np.ptp(light[~points]) == 0
        assert light.max() < (BRIGHTEST + 1) * light[~points][0]


def test_a_layer_that_slides_moves_by_its_speed():
    light = np.random.default_rng(2).random((80, 80))
    still = Path2D((20.0, 20.0), (1.25, -3.5), (0.0, 0.0), 0.3, 0.0, 0.0, 0.0, 0.0)
    flow = frame([Layer(light, None, still)], (16, 18), 0.5)[1]
    np.testing.assert_allclose(flow[0], -3.5, atol=1e-5)
    np.testing.assert_allclose(flow[1], 1.25, atol=1e-5)


def test_the_largest_motion_is_kept_and_some_clips_are_still():
    """Two hundred draws at 16 px/frame: no pixel moves twice that far, some clips rest, half move 3 px or more."""
    rng = np.random.default_rng(3)
    flat = [np.ones((64, 64))]
    largest = []
    for _ in range(200):
        flow = frame(layers(flat, (30, 30), 16.0, rng), (30, 30), float(rng.uniform(-8, 8)))[1]
        largest.append(float(np.hypot(*flow).max()))
    assert max(largest) < 32
    assert 10 <= sum(value < 1e-6 for value in largest) <= 60  # 15 % +- 5 sigma
    assert np.median(largest) > 3


def test_a_repeat_gives_the_same_bytes_and_keeps_what_is_there(pictures, tmp_path, capsys):
    assert run(pictures, tmp_path / "once", "--clips", 3) == 0
    assert run(pictures, tmp_path / "again", "--clips", 2) == 0
    assert run(pictures, tmp_path / "again", "--clips", 3, "--split", "val") == 0
    assert capsys.readouterr().out.endswith("1 clips made, 2 were there; 2 of these keep another split than val\n")
    for n in range(3):
        once, again = (Clip.open(tmp_path / name / f"warped_{n:05d}") for name in ("once", "again"))
        assert once.info.checksums == again.info.checksums
        assert once.shape == (5, 24, 30)
        assert once.verify() == []
    assert (tmp_path / "once/LICENCE.txt").read_text() == "CC0"
    assert [clip.name for clip in open_clips(tmp_path / "again", "train")] == ["warped_00000", "warped_00001"]
    assert [clip.name for clip in open_clips(tmp_path / "again", "val")] == ["warped_00002"]
    assert len(open_clips(tmp_path / "again")) == 3


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--seed", 1], "seed, motion, shake or patterns"),
        (["--motion", 4], "seed, motion, shake or patterns"),
        (["--shake", 0], "seed, motion, shake or patterns"),
        (["--patterns", 1], "seed, motion, shake or patterns"),
        (["--frames", 6], "size"),
        ([], "set of pictures"),
    ],
)
def test_clips_of_other_settings_are_not_taken_for_these(pictures, tmp_path, capsys, words, named):
    """They were kept and counted, and the folder got two kinds of clips."""
    assert run(pictures, tmp_path / "out", "--clips", 1) == 0
    if not words:
        (pictures / "b.jpg").rename(pictures.parent / "b.jpg")
    capsys.readouterr()
    assert run(pictures, tmp_path / "out", "--clips", 2, *words) == 2
    said = capsys.readouterr().err
    assert f"{tmp_path / 'out' / 'warped_00000'}: was made with another {named}; name another folder" in said
    assert said.count("\n") == 1
    assert not (tmp_path / "out" / "warped_00001").exists()


def test_a_second_licence_leaves_the_first_one(pictures, tmp_path):
    """Pictures of two licences in one folder, as docs/datasets.md shows: a repeat adds no third file."""
    texts = ["CC0", "CC BY 4.0", "CC0", "CC BY 4.0"]
    for n, text in enumerate(texts):
        (tmp_path / "licence.txt").write_text(text)
        assert run(pictures, tmp_path / "out", "--clips", 1, "--first", n) == 0
    found = {path.name: path.read_text() for path in (tmp_path / "out").glob("LICENCE*")}
    digest = files.sha256(b"CC BY 4.0")
    assert found == {"LICENCE.txt": "CC0", f"LICENCE-{digest[:8]}.txt": "CC BY 4.0"}


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--height", 200], "half of which is less than 200 px"),
        (["--motion", -1], "expected a number from 0 to 100"),
        (["--clips", 0], "expected a whole number"),
        (["--licence", "none.txt"], "none.txt: no such file; name the file that states the licence"),
    ],
)
def test_a_mistake_is_one_line(pictures, tmp_path, capsys, words, named):
    assert run(pictures, tmp_path / "out", *words) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert named in said
    assert not list(tmp_path.glob("out/*"))
