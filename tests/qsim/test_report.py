"""Reports: a page for every kind of thing, offline, and one clear sentence where there is nothing to show."""

import json
import re
import shutil
import subprocess

import numpy as np
import pytest

from qsim import report
from qsim.cli import main
from qsim.clip import RELATIVE, Clip, ClipWriter


def make_clip(path, frames: int = 5, size: tuple[int, int] = (24, 33)) -> Clip:
    """A bright square that moves one pixel per frame, with its flow."""
    meta = {"shape": [frames, *size], "frame_rate": 2000.0, "exposure": 5e-4, "radiance_unit": RELATIVE}
    with ClipWriter(path, meta) as writer:
        for t in range(frames):
            radiance = np.full(size, 0.1, np.float32)
            radiance[6:12, 4 + t : 10 + t] = 1.0
            flow = np.zeros((2, *size), np.float32)
            flow[0, 6:12, 4 + t : 10 + t] = 1.0
            writer.add(t, radiance, truth={"flow": flow, "flow_back": -flow, "valid": np.ones(size, bool)}, error=0.01)
    return Clip.open(path)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A clip with a stream, a restored video of it, a training curve and an evaluation."""
    top = tmp_path_factory.mktemp("report")
    clip = make_clip(top / "square")
    assert main(["sense", str(clip.path), "--ppp", "3.25", "--bits", "3"]) == 0
    stream = Clip.open(clip.path).stream(Clip.open(clip.path).streams[0])
    restored = {
        "format": "quiver-restored-1",
        "method": "moment",
        "description": "moment inverse",
        "seconds_per_frame": 0.1,
        "source": str(stream.path),
    }
    np.save(top / "video.npy", np.full(clip.shape, 3.25, np.float32))
    (top / "video.json").write_text(json.dumps(restored))
    entry = {"step": 10, "elapsed": 60.0, "psnr_matched": 21.5}
    (top / "history.json").write_text(json.dumps({"settings": {}, "history": [entry, entry | {"elapsed": 120.0}]}))
    interval = {"mean": 20.0, "half_width": 1.0, "scenes": 2}
    line = {"method": "<moment>", "light": "3.25 PPP", "seconds_per_frame": 0.1, "truth_psnr": None}
    line["scores"] = {"psnr": interval, "psnr_matched": interval, "ssim_matched": interval | {"half_width": None}}
    evaluation = {"format": "quiver-evaluation-1", "table": [line], "not_built_yet": ["RVRT"]}
    (top / "evaluation.json").write_text(json.dumps(evaluation))
    (top / "unknown.json").write_text("[1, 2]")
    return top


def test_page_shows_everything_and_loads_nothing(folder):
    page = report.build(folder, title="All", notes=["a note"])
    for words in ("Clip square", "Restored: video", "Training", "Methods compared", "20.00 ± 1.00", "a note", "RVRT"):
        assert words in page, words
    assert "&lt;moment&gt;" in page
    assert page.count('class="player"') == 2
    addresses = re.findall(r'(?:src|href|data-strip)="([^"]*)"', page)
    assert all(address.startswith("data:") for address in addresses)


def test_average_is_the_mean_of_the_codes_around(folder):
    stream = Clip.open(folder / "square").stream(Clip.open(folder / "square").streams[0])
    codes = stream.codes(0, 5)
    shown = report.stream_panels(stream, range(5))[1].frames
    mean = codes.mean(axis=0) / 7  # five frames: every window of eleven holds all of them
    assert np.array_equal(shown[0], shown[4])
    brightest = np.unravel_index(np.argmax(mean), mean.shape)
    assert shown[2][brightest] == 255


def test_one_clip_alone(folder):
    assert report.build(folder / "square").count("<h2>") == 1


def test_command_writes_and_does_not_overwrite(folder, tmp_path, capsys):
    target = tmp_path / "page.html"
    assert main(["report", str(folder / "square"), "-o", str(target), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["bytes"] == target.stat().st_size
    assert main(["report", str(folder / "square"), "-o", str(target)]) == 2
    assert "--force" in capsys.readouterr().err


@pytest.mark.parametrize("what", ["missing", "empty"])
def test_nothing_to_show_is_said(tmp_path, capsys, what):
    path = tmp_path / what
    if what == "empty":
        path.mkdir()
    assert main(["report", str(path), "-o", str(tmp_path / "x.html")]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert str(path) in message
    assert not (tmp_path / "x.html").exists()


@pytest.mark.skipif(shutil.which("chromium") is None, reason="no chromium to look at the page with")
def test_page_draws_in_a_real_browser(folder, tmp_path):
    """The screenshot is not blank, and dark and bright parts of the strip are both there."""
    from PIL import Image

    page, picture = tmp_path / "page.html", tmp_path / "page.png"
    page.write_text(report.build(folder))
    options = "--headless --no-sandbox --disable-gpu --no-first-run --disable-background-networking --disable-sync"
    command = ["chromium", *options.split(), f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=3000"]
    subprocess.run([*command, f"--screenshot={picture}", page.as_uri()], check=True, capture_output=True, timeout=120)
    pixels = np.asarray(Image.open(picture).convert("L"))
    assert (pixels < 60).mean() > 0.005
    assert (pixels > 200).mean() > 0.2
