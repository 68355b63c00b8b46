"""Tests pages: every kind of result, nothing loaded from elsewhere, one line of error if there is no result."""

import json
import re

import pytest
from browser import browser, needs_chromium
from clips import write_dataset

from qsim.cli.program import main
from qsim.report import report


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


def test_command_writes_and_does_not_overwrite(folder, tmp_path, capsys):
    target = tmp_path / "page.html"
    assert main(["report", str(folder / "square"), "-o", str(target), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["bytes"] == target.stat().st_size
    assert main(["report", str(folder / "square"), "-o", str(target)]) == 2
    assert "--force" in capsys.readouterr().err


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
    assert "Data set tiny has 4 clips (1 test, 2 train, 1 val) with 56 frames in all." in page
    assert re.findall(r"<h2>(.*?)</h2>", page) == ["Data set tiny", "Clip test_0", "Clip train_0", "Clip val_0"]
    assert "4 clips; motion in the middle frame" in page


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
