"""Tests pages: every kind of result, nothing loaded from elsewhere, one line of error if there is no result."""

import json
import re
import shutil
import subprocess

import numpy as np
import pytest
from clips import write_dataset

from qsim.cli.program import main
from qsim.report import report


def test_page_shows_everything_and_loads_nothing(folder):
    page = report.build_page(folder, title="All", notes=["a note"])
    for words in ("Clip square", "Restored: video", "Training", "Methods compared", "20.00 ± 1.00", "a note", "RVRT"):
        assert words in page, words
    assert "&lt;moment&gt;" in page
    assert page.count('class="player"') == 2
    assert "recorded video" in page  # an imported video is not called the truth
    assert "light of the truth" not in page
    addresses = re.findall(r'(?:src|href|data-strip)="([^"]*)"', page)
    assert all(address.startswith("data:") for address in addresses)


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
    assert re.findall(r"<h2>(.*?)</h2>", page) == ["Data set tiny", "Clip test_0", "Clip train_0", "Clip val_0"]
    assert "4 clips; motion in the middle frame" in page


DRIVE = """<script>
const found = {errors: []};
window.addEventListener("error", event => found.errors.push(event.message));
console.error = (...words) => found.errors.push(words.join(" "));
window.addEventListener("load", () => setTimeout(() => {
  try {
    const player = document.querySelector(".player"), canvas = player.querySelector("canvas");
    const slider = player.querySelector("input.frame"), label = player.querySelector("output");
    const look = c => Array.from(c.getContext("2d").getImageData(0, 0, c.width, c.height).data).join();
    const first = look(canvas);
    found.size = [canvas.width, canvas.height];
    slider.value = 3; slider.dispatchEvent(new Event("input", {bubbles: true}));
    found.label = label.textContent;
    found.moved = look(canvas) !== first;
    player.dispatchEvent(new KeyboardEvent("keydown", {key: "Home", bubbles: true}));
    found.home = label.textContent + (look(canvas) === first);
    player.dispatchEvent(new KeyboardEvent("keydown", {key: "ArrowLeft", bubbles: true}));
    found.last = label.textContent;
    player.querySelector("button.play").click();
    found.playing = player.querySelector("button.play").textContent;
    player.querySelector("button.play").click();
    player.querySelector("details").open = true;
    const reveal = player.querySelector("input.reveal"), over = player.querySelector("canvas.over");
    reveal.value = 25; reveal.dispatchEvent(new Event("input", {bubbles: true}));
    found.clip = over.style.clipPath;
    found.under = look(player.querySelector("canvas.under")) !== look(over);
    found.wide = document.documentElement.scrollWidth <= window.innerWidth;
    found.dark = getComputedStyle(document.body).backgroundColor;
  } catch (error) { found.errors.push(String(error)); }
  document.title = JSON.stringify(found);
}, 500));
</script>"""


def chromium(*words: object, profile: object) -> str:
    """Return the standard output of a headless Chromium."""
    options = "--headless --no-sandbox --disable-gpu --no-first-run --disable-background-networking --disable-sync"
    command = [
        "chromium",
        *options.split(),
        f"--user-data-dir={profile}",
        "--virtual-time-budget=5000",
        *map(str, words),
    ]
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=240).stdout


@pytest.mark.skipif(shutil.which("chromium") is None, reason="no chromium to look at the page with")
@pytest.mark.parametrize("dark", [False, True])
def test_page_works_in_a_real_browser(folder, tmp_path, dark):
    """At a phone's width: the scrubber moves frames, keys step, the slider reveals, without errors or overflow."""
    import html

    page = tmp_path / "page.html"
    page.write_text(report.build_page(folder).replace("<head>", "<head>" + DRIVE, 1))
    words = ["--window-size=500,900", "--dump-dom", page.as_uri()]
    dom = chromium(*(["--blink-settings=preferredColorScheme=0"] if dark else []), *words, profile=tmp_path / "p")
    found = json.loads(html.unescape(re.search(r"<title>(\{.*?)</title>", dom)[1]))
    assert found.pop("errors") == []
    background = found.pop("dark")
    assert (background == "rgb(21, 23, 26)") is dark
    assert found == {
        "size": [33, 24],
        "label": "frame 4 / 5",
        "moved": True,
        "home": "frame 1 / 5true",
        "last": "frame 5 / 5",
        "playing": "pause",
        "clip": "inset(0px 75% 0px 0px)",
        "under": True,
        "wide": True,
    }


@pytest.mark.skipif(shutil.which("chromium") is None, reason="no chromium to look at the page with")
def test_a_screenshot_is_not_blank(folder, tmp_path):
    """The screenshot has dark and bright pixels."""
    from PIL import Image

    page, picture = tmp_path / "page.html", tmp_path / "page.png"
    page.write_text(report.build_page(folder))
    chromium(f"--screenshot={picture}", page.as_uri(), profile=tmp_path / "profile")
    pixels = np.asarray(Image.open(picture).convert("L"))
    assert (pixels < 60).mean() > 0.005
    assert (pixels > 200).mean() > 0.2
