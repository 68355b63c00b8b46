"""Tests pages: every kind of result, nothing loaded from elsewhere, one line of error if there is no result."""

import json
import re

import numpy as np
import pytest
from browser import browser, needs_chromium
from clips import describe_video, write_clip, write_dataset

from qsim.cli.program import main
from qsim.clip.clip_info import RELATIVE
from qsim.clip.writer import ClipWriter
from qsim.report import report
from qsim.streams.clip import Clip


def test_page_shows_everything_and_loads_nothing(folder):
    page = report.build_page(folder, title="All", notes=["a note"])
    for words in ("Clip square", "Restored: video", "Training", "Methods compared", "20.00 ± 1.00", "a note"):
        assert words in page, words
    assert "RVRT" not in page, "no to-do list of ours"
    assert "Training" in page.split("</header>")[0], "the top tells the results"
    assert "&lt;moment&gt;" in page
    assert page.count('class="player"') == 3  # restored; light, and ground truth of the clip
    titles = re.findall(r"<h2>(.*?)</h2>", page)
    assert [re.sub("<.*?>", "", link) for link in re.findall(r'<li><a href="#s\d+">(.*?)</a>', page)] == titles
    assert f"{len(titles) - 1} results under" in page
    assert "recorded video" in page  # an imported video is not called the truth
    assert "light of the truth" not in page
    addresses = re.findall(r'(?:src|href|data-strip)="([^"]*)"', page)
    assert all(address.startswith(("data:", "#")) for address in addresses)


def test_one_clip_alone(folder):
    assert report.build_page(folder / "square").count("<h2>") == 1


def test_ground_truth_lies_over_restored_video(tmp_path):
    """Flow, depth, bodies and hidden points: of each kind that the clip has, a panel beside the restored video."""
    light = np.full((3, 8, 10), 0.5, np.float32)
    half = np.arange(10) < 5
    truth = {
        "flow": np.ones((2, 8, 10), np.float32),
        "flow_back": -np.ones((2, 8, 10), np.float32),
        "depth": np.broadcast_to(np.where(half, 1.0, 2.0), (8, 10)).astype(np.float32),
        "body_id": np.broadcast_to(half, (8, 10)).astype(np.int32),
        "valid": np.broadcast_to(half, (8, 10)),
    }
    meta = {"shape": [3, 8, 10], "frame_rate": 2000.0, "exposure": 5e-4, "radiance_unit": RELATIVE}
    with ClipWriter(tmp_path / "c", meta) as writer:
        for t in range(3):
            writer.add(t, light[t], truth=truth, error=0.01)
    stream = Clip.open(tmp_path / "c").sense(ppp=3.25, bits=3)
    np.save(tmp_path / "v.npy", light)
    describe_video(tmp_path / "v.json", description="moment inverse", source=str(stream.path))
    body = report.restored_section(tmp_path / "v.json").body
    for words in ("restored by moment", "flow, full colour", "depth, 1 m", "bodies, one colour", "red: hidden"):
        assert words in body, words


def test_several_paths_are_one_page_without_repetition(folder, tmp_path, capsys, monkeypatch):
    clip = folder / "square"
    video = folder / "video.npy"
    assert report.build_page(clip, video, clip).count("<h2>") == 2
    assert report.build_page(folder, clip).count("<h2>") == report.build_page(folder).count("<h2>")
    with pytest.raises(ValueError, match="empty: nothing to report"):
        report.build_page(clip, _made(tmp_path / "empty"))
    monkeypatch.chdir(tmp_path)
    assert main(["report", str(clip), str(video)]) == 0
    assert "report.html: " in capsys.readouterr().out


def _made(path):
    path.mkdir()
    return path


def test_command_writes_and_does_not_overwrite(folder, tmp_path, capsys):
    target = tmp_path / "page.html"
    assert main(["report", str(folder / "square"), "-o", str(target), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["bytes"] == target.stat().st_size
    assert main(["report", str(folder / "square"), "-o", str(target)]) == 2
    assert "--force" in capsys.readouterr().err


def test_clips_whose_names_hold_a_dot_have_pages_of_their_own(tmp_path, monkeypatch):
    """A folder's name has no ending: two speeds of a scene do not share one page. A file's ending is left out."""
    monkeypatch.chdir(tmp_path)
    for name in ("fan_x0.25", "fan_x0.5"):
        write_clip(tmp_path / name, frames=2, height=8, width=9)
        assert main(["report", name]) == main(["explore", name]) == 0
    found = {"setting": {"height": 64}, "costs": [{"method": "moment", "seconds_per_frame": 0.25}]}
    (tmp_path / "bench.json").write_text(json.dumps(found))
    assert main(["report", "bench.json"]) == 0
    pages = {path.name for path in tmp_path.glob("*.html")}
    clips = {"fan_x0.25.html", "fan_x0.25_explore.html", "fan_x0.5.html", "fan_x0.5_explore.html"}
    assert pages == clips | {"bench.html"}


@pytest.mark.parametrize("what", ["missing", "empty"])
def test_a_path_without_results_is_refused(tmp_path, capsys, what):
    path = tmp_path / what
    if what == "empty":
        path.mkdir()
    assert main(["report", str(path), "-o", str(tmp_path / "x.html")]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert str(path) in message
    assert not (tmp_path / "x.html").exists()


def test_a_data_set_is_a_table_and_a_clip_of_each_split(tmp_path):
    data = write_dataset(tmp_path / "tiny", {"train": 2, "val": 1, "test": 1})
    steps: list[tuple[int, int]] = []
    page = report.build_page(data, progress=lambda done, total: steps.append((done, total)))
    assert steps == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert page.count('class="player"') == 3
    assert "Data set tiny has 4 clips (2 train, 1 val, 1 test) with 56 frames in all." in page
    assert re.findall(r"<h2>(.*?)</h2>", page) == [
        "Data set tiny",
        "Clip test_0000",
        "Clip train_0000",
        "Clip val_0000",
    ]
    assert "4 clips; motion in the middle frame" in page


def test_a_portrait_of_many_frames_has_a_page(tmp_path):
    """A clip, its codes, and restored video of 48 frames with 768 rows: 41 of them fit into a picture."""
    clip = write_clip(tmp_path / "tall", radiance=np.full((48, 768, 2), 0.5), relative=True)
    stream = clip.sense(ppp=3.25, bits=3)
    np.save(tmp_path / "v.npy", np.full((48, 3, 768, 2), 3.25, np.float32))
    describe_video(tmp_path / "v.json")
    page = report.build_page(clip.path, tmp_path / "v.npy")
    assert page.count('data-frames="41"') == page.count('class="player"') == 2
    assert stream.name in page
    assert "moment; 100 ms per frame." in page, "a description is optional"


def look(selector: str) -> str:
    """An expression for the pixels of a canvas as text."""
    canvas = f"document.querySelector('{selector}')"
    return f"(c => c.getContext('2d').getImageData(0, 0, c.width, c.height).data.join())({canvas})"


@pytest.fixture(scope="module")
def tab(tmp_path_factory):
    with browser(tmp_path_factory.mktemp("profile")) as page:
        yield page


@pytest.fixture(scope="module")
def written(folder, tmp_path_factory):
    target = tmp_path_factory.mktemp("page") / "page.html"
    target.write_text(report.build_page(folder))
    return target


@needs_chromium
def test_a_player_plays_steps_and_reveals(written, tab):
    """Scrubber, keys, play, the dragged line, the choice by a click, and the magnifier."""
    tab.open(written)
    tab.wait("document.querySelector('.panels canvas').width === 33")
    first = tab.value(look(".panels canvas"))
    label = "document.querySelector('.player output').textContent"
    tab.value("(s => { s.value = 3; s.dispatchEvent(new Event('input')); })(document.querySelector('input.frame'))")
    assert tab.value(label) == "frame 4 / 5"
    assert tab.value(look(".panels canvas")) != first
    tab.value("document.querySelector('.player').focus({ focusVisible: true })")
    tab.press("Home", 36)
    assert tab.value(label) == "frame 1 / 5"
    assert tab.value(look(".panels canvas")) == first
    tab.press("ArrowLeft", 37)
    assert tab.value(label) == "frame 5 / 5"
    tab.press(" ", 32)
    assert tab.value("document.querySelector('button.play').textContent") == "pause"
    tab.press(" ", 32)
    assert tab.value("document.querySelector('button.play').getAttribute('aria-pressed')") == "false"
    tab.value("document.querySelector('.stage').scrollIntoView({ block: 'center' })")
    left, top, width, height = tab.value(
        "(b => [b.left, b.top, b.width, b.height])(document.querySelector('.stage').getBoundingClientRect())"
    )
    assert width > 0.6 * 1280 or height > 0.65 * 900, "the comparison is open and fills the width or the height"
    tab.drag((left + width / 2, top + height / 2), (left + width / 4, top + height / 2))
    assert tab.value("Number(document.querySelector('input.reveal').value)") == pytest.approx(25, abs=0.5)
    inset = tab.value("getComputedStyle(document.querySelector('.layer.over')).clipPath")
    assert "75%" in inset or "calc" in inset, inset
    tab.value("document.querySelectorAll('.panels canvas')[1].click()")
    assert tab.value("document.querySelector('select.right').value") == "1"
    assert tab.value(look("canvas.right")) == tab.value(look(".panels figure:nth-child(2) canvas"))
    tab.value("(s => { s.value = 4; s.dispatchEvent(new Event('input')); })(document.querySelector('select.magnify'))")
    assert tab.value("getComputedStyle(document.querySelector('.layer canvas')).transform").startswith("matrix(4,")
    assert tab.problems == []


@needs_chromium
@pytest.mark.parametrize("dark", [False, True])
def test_a_phone_sees_picture_and_scrubber_together(written, tab, dark):
    """No sideways scroll, the contents stay in view, and figures have the colour of the text."""
    tab.open(written, width=390, height=844, dark=dark)
    assert tab.value("document.documentElement.scrollWidth") <= 390
    background = tab.value("getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number)")
    assert (max(background) < 60) if dark else (min(background) > 200)
    assert tab.value("getComputedStyle(document.querySelector('figure svg text')).fill") == tab.value(
        "getComputedStyle(document.body).color"
    )
    tab.value("document.querySelector('.stage').scrollIntoView({ block: 'center' })")
    for selector in (".stage", "input.frame", "nav.contents"):
        top, bottom = tab.value(
            f"(b => [b.top, b.bottom])(document.querySelector('{selector}').getBoundingClientRect())"
        )
        assert -1 <= top < bottom <= 845, selector
    wide = "[...document.querySelectorAll('.scroll')].filter(t => t.scrollWidth > t.clientWidth)"
    assert tab.value(f"{wide}.every(t => t.tabIndex === 0)"), "tables that scroll can be reached by the keyboard"
    assert tab.value("[...document.querySelectorAll('figcaption')].every(c => c.scrollWidth <= 390)")
    tab.value("document.querySelector('.panels').lastElementChild.scrollIntoView({ block: 'end' })")
    bottom = tab.value("document.querySelector('input.frame').getBoundingClientRect().bottom")
    assert 0 < bottom <= 845, "the scrubber stays below the panels that it moves"
    assert tab.problems == []


def test_video_of_a_replaced_stream_is_not_scored_against_it(tmp_path):
    """The new stream of another light, of the same name, gave the restored video a PSNR."""
    clip = write_clip(tmp_path / "c", frames=4, height=12, width=14)
    stream = clip.sense(ppp=3.25, bits=3, name="s")
    np.save(tmp_path / "v.npy", np.full((4, 12, 14), 3.25, np.float32))
    about = {"source": str(stream.path)}
    known = {"shape": (4, 12, 14), "source_sha256": stream.info.sha256}
    for changes, scored in (
        (known, True),
        (known | {"source_sha256": "0" * 64}, False),
    ):
        describe_video(tmp_path / "v.json", **about, **changes)
        body = report.restored_section(tmp_path / "v.json").body
        assert ("both clamped at" in body) == scored
        assert ("Its stream was replaced since" in body) != scored
    clip.sense(ppp=9.75, bits=3, name="s", force=True)
    describe_video(tmp_path / "v.json", **about, **known)
    assert "Its stream was replaced since" in report.restored_section(tmp_path / "v.json").body
