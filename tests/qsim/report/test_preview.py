"""Tests previews: pictures with legend and declaration, films with all frames, half blocks in terminals."""

import json
import os
import pty
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from qsim import colour as pictures
from qsim.cli.program import main
from qsim.report import preview
from qsim.report.views import choose, open_source


def test_png_holds_picture_legend_and_declaration(clip, tmp_path, capsys):
    target = tmp_path / "new" / "a.png"
    assert (
        main(["preview", str(clip.path), "-o", str(target), "--frame", "1", "--what", "sharp,flow", "--scale", "3"])
        == 0
    )
    out = capsys.readouterr().out
    assert "frame 1 of odd" in out
    assert "curve (value / brightest shown)^(1/2.2)" in out
    image = Image.open(target)
    pixels = np.asarray(image)
    assert pixels.shape[0] % 2 == pixels.shape[1] % 2 == 0
    views = open_source(clip.path).views
    assert np.array_equal(pixels[: 8 * 3 : 3, : 11 * 3 : 3], views["sharp"].picture(1))
    below = pixels[24:].reshape(-1, 3)
    wheel = [[255, 0, 0], [0, 255, 255]]  # the ends of the legend's horizontal
    assert all((np.abs(below.astype(int) - colour).max(axis=1) < 40).any() for colour in wheel)
    declared = json.loads(image.text["Description"])
    sidecar = json.loads(target.with_name("a.png.json").read_text())
    assert declared["views"] == sidecar["views"]
    assert sidecar["frames"] == [1, 2]


def test_gif_and_mp4_have_every_frame(clip, tmp_path):
    import av

    for name in ("a.gif", "a.mp4"):
        assert main(["preview", str(clip.path), "-o", str(tmp_path / name), "--fps", "10"]) == 0
    with Image.open(tmp_path / "a.gif") as gif:
        assert gif.n_frames == 5
        assert gif.info["duration"] == 100
        assert gif.info["loop"] == 0
    with av.open(str(tmp_path / "a.mp4")) as film:
        decoded = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    assert len(decoded) == 5
    page = preview.sheet(choose(open_source(clip.path), None))
    for t, frame in enumerate(decoded):
        assert np.abs(frame.astype(int) - page.frame(t)).mean() < 6, "lossy, but this frame"


@pytest.mark.parametrize("rate", [12, 30, 40])
def test_a_gif_plays_at_the_rate_asked_for(clip, tmp_path, rate):
    """A GIF counts in hundredths of a second: its frames last 2 or 3 of them, 2.5 on average."""
    assert main(["preview", str(clip.path), "-o", str(tmp_path / "a.gif"), "--what", "sharp", "--fps", str(rate)]) == 0
    with Image.open(tmp_path / "a.gif") as gif:
        durations = [(gif.seek(t), gif.info["duration"])[1] for t in range(gif.n_frames)]
    assert len(durations) == 5
    assert sum(durations) == pytest.approx(5 * 1000 / rate, abs=5)


def test_a_gif_of_one_frame(tmp_path):
    np.save(tmp_path / "one.npy", np.ones((1, 4, 5)))
    assert main(["preview", str(tmp_path / "one.npy"), "-o", str(tmp_path / "a.gif"), "--fps", "10"]) == 0
    with Image.open(tmp_path / "a.gif") as gif:
        assert gif.n_frames == 1


@pytest.mark.parametrize("rate", ["0.01", "0.4", "23.976"])
def test_a_film_plays_at_the_rate_asked_for(clip, tmp_path, rate):
    import av

    assert main(["preview", str(clip.path), "-o", str(tmp_path / "a.mp4"), "--what", "sharp", "--fps", rate]) == 0
    with av.open(str(tmp_path / "a.mp4")) as film:
        assert film.streams.video[0].average_rate == Fraction(rate)
        assert sum(1 for _ in film.decode(video=0)) == 5
    assert json.loads((tmp_path / "a.mp4.json").read_text())["shown_fps"] == float(rate)


def test_legends_follow_their_pictures():
    bar = pictures.depth_legend(2, 50)
    assert np.array_equal(bar[0, 0], pictures.depth_colours(np.array([[1.0]]), 1.0, 9.0)[0, 0])
    assert np.array_equal(bar[0, -1], pictures.depth_colours(np.array([[9.0]]), 1.0, 9.0)[0, 0])


def test_half_blocks_carry_both_pixels():
    picture = np.arange(3 * 2 * 3, dtype=np.uint8).reshape(3, 2, 3)
    lines = preview.half_blocks(picture).split("\n")
    assert len(lines) == 2
    assert lines[0].startswith("\x1b[38;2;0;1;2m\x1b[48;2;6;7;8m▀")
    assert "\x1b[49m" in lines[1], "an odd last row has nothing below"


def test_shades_of_a_dim_picture_have_full_contrast_and_a_flat_one_its_level():
    dim = np.repeat(np.linspace(100, 140, 50)[None, :, None], 3, axis=2).astype(np.uint8)
    text = preview.shades(dim)
    assert (text[0], text[-1], len(set(text))) == (preview.SHADES[0], preview.SHADES[-1], len(preview.SHADES))
    assert preview.shades(np.full((2, 4, 3), 255, np.uint8)) == "@@@@"
    assert preview.shades(np.zeros((2, 4, 3), np.uint8)) == "    "


def test_shades_go_from_dark_to_light():
    ramp = np.repeat(np.linspace(0, 255, 10).astype(np.uint8)[None, :, None], 3, axis=2)
    assert preview.shades(ramp) == preview.SHADES


def test_fit_keeps_the_shape_and_never_enlarges():
    picture = np.zeros((60, 80, 3), np.uint8)
    assert preview.fit_terminal(picture, 40, 100).shape == (30, 40, 3)
    assert preview.fit_terminal(picture, 100, 15).shape == (30, 40, 3)
    assert preview.fit_terminal(picture, 100, 100) is picture


def _in_a_terminal(*words: object, **environment: str) -> str:
    """Return the output of a command in a terminal of 30 columns."""
    master, slave = pty.openpty()
    env = {**os.environ, "COLUMNS": "30", "LINES": "20", **environment}
    command = [sys.executable, "-m", "qsim", *map(str, words)]
    done = subprocess.Popen(command, stdout=slave, stderr=slave, env=env, cwd=Path(__file__).parents[3])
    os.close(slave)
    found = b""
    while True:
        try:
            found += (chunk := os.read(master, 65536))
        except OSError:  # the other end is closed
            break
        if not chunk:
            break
    os.close(master)
    assert done.wait(timeout=60) == 0, found
    return found.decode()


def test_a_terminal_shows_colour_and_plays_every_frame(clip):
    shown = _in_a_terminal("preview", clip.path, "--what", "flow", "--play", "--fps", "200", NO_COLOR="")
    assert "\x1b[38;2;255;0;0m" in shown
    assert shown.count("\x1b[5A") == 4, "four rows of characters, five frames: back up four times"
    assert "frame 4 of odd, flow to the next frame" in shown


def test_no_colour_where_it_is_not_wanted(clip, capsys):
    assert "\x1b[38" not in _in_a_terminal("preview", clip.path, NO_COLOR="1")
    assert main(["preview", str(clip.path)]) == 0
    assert "\x1b" not in capsys.readouterr().out


def test_json_declares_without_drawing(clip, capsys):
    assert main(["preview", str(clip.path), "--json", "--what", "depth"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["views"][0]["what"] == "depth"
    assert found["views"][0]["far"] == pytest.approx(3.5714, abs=0.1)
    assert found["frames"] == [2, 3]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("{clip} -o a.webm", "a.webm: a preview is a .mp4, .gif, .png file, as in -o a.mp4"),
        ("{clip} --frame 5", "--frame 5: odd has frames 0..4"),
        ("{clip} --what radiance", "odd: has no view 'radiance'; it has: sharp, codes, average, flow, depth"),
        ("{clip} --what sharpp", "flow, depth, values, got 'sharpp' (did you mean 'sharp'?)"),
        ("{clip} --fps 0", "--fps: expected a number from 0.01 to 1000, got '0'"),
        (
            "{clip} -o a.gif --fps 60",
            "--fps 60: a GIF plays at most 50 frames per second; write a.mp4, or give --fps 50 or",
        ),
        ("{clip} --scale 0", "--scale: expected a whole number from 1 to 64, got '0'"),
        ("{clip} --stream other", "no stream 'other'; there are: mine"),
        ("codes.npy", "codes.npy: whole numbers are codes or packed planes; add --bits 3, or --width 320"),
        ("codes.npy --bits 2", "value 5 at (t, y, x) = (0, 1, 1) is not a 2-bit code"),
        ("codes.npy --bits 17", "--bits: expected a whole number from 1 to 16, got '17'"),
        ("codes.npy --width 99", "does not hold packed planes of 99 columns; a row of those has 13 bytes of uint8"),
        ("four.npy", "four.npy: expected frames [T, H, W], found an array of shape [1, 2, 3, 4]"),
        ("words.txt", "words.txt: expected a clip folder, a stream or a .npy array; `qsim convert` reads other files"),
        ("none", "none: no such clip"),
    ],
)
def test_mistakes_are_one_line(clip, tmp_path, monkeypatch, capsys, words, message):
    monkeypatch.chdir(tmp_path)
    np.save("codes.npy", np.full((2, 4, 5), 5, np.uint8) * (np.arange(20).reshape(4, 5) == 6))
    np.save("four.npy", np.zeros((1, 2, 3, 4)))
    Path("words.txt").write_text("words")
    before = sorted(tmp_path.iterdir())
    assert main(["preview", *words.format(clip=clip.path).split()]) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.err.count("\n") == 1
    assert captured.out == ""
    assert sorted(tmp_path.iterdir()) == before


def test_neither_the_picture_nor_its_json_is_replaced_without_force(clip, tmp_path, capsys):
    target = tmp_path / "a.png"
    beside = tmp_path / "a.png.json"
    beside.write_text("mine")
    assert main(["preview", str(clip.path), "-o", str(target), "--what", "sharp"]) == 2
    assert "a.png.json: exists; name another, or replace it with --force" in capsys.readouterr().err
    assert (beside.read_text(), target.exists()) == ("mine", False)
    assert main(["preview", str(clip.path), "-o", str(target), "--what", "sharp", "--force"]) == 0
    assert json.loads(beside.read_text())["frames"] == [2, 3]
