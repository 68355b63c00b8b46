"""Reports: a page for every kind of thing, offline, and one clear sentence where there is nothing to show."""

import json
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from clips import write_clip, write_dataset
from stats import mixture_p_value

from qsim.cli.program import main
from qsim.clip.clip import Clip
from qsim.clip.manifest import RELATIVE
from qsim.clip.photons import clip_photons
from qsim.clip.sensing import Sensing, sense
from qsim.clip.writer import ClipWriter
from qsim.report import clip_section, report
from qsim.studies.validation.reading import ReadingReport


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
    assert "recorded video" in page  # what another camera saw is not called the truth
    assert "light of the truth" not in page
    addresses = re.findall(r'(?:src|href|data-strip)="([^"]*)"', page)
    assert all(address.startswith("data:") for address in addresses)


DEVICES = {
    "dark map": '[sensor]\nmodel = "BinarySPAD"\npde = 0.4\ndark_count_rate = 900.0\nbits = 2\n'
    "[defects]\ndevice_seed = 3\ndead = 0.05\ndark = { hot_share = 0.2 }\n",
    "QIS": '[sensor]\nmodel = "QIS"\nquantum_efficiency = 0.8\ndark_current = 400.0\nread_noise = 0.2\nbits = 3\n'
    "[defects]\ndevice_seed = 4\nprnu = 0.3\ndead = 0.1\noffset = 0.6\nread_noise = 0.5\n",
    "measured": '[sensor]\nmodel = "BinarySPAD"\npde = 0.4\ndark_count_rate = 1.0\nbits = 1\n'
    '[defects]\ndark_map = "rates.npy"\n',
}


@pytest.mark.parametrize("name", DEVICES)
def test_the_expected_codes_include_the_maps(tmp_path, name):
    """The drawn histogram against the marks, by chi-square; the sensor's own distribution without the maps fails it."""
    (tmp_path / "device.toml").write_text(DEVICES[name])
    rates = np.random.default_rng(5).lognormal(7, 1, (40, 60))
    np.save(tmp_path / "rates.npy", rates)
    clip = make_clip(tmp_path / "clip", frames=6, size=(24, 33))
    stream, _ = sense(clip, Sensing(str(tmp_path / "device.toml"), ppp=2.0, name="mine"))
    clip = Clip.open(clip.path)
    assert clip_section.unexpected(clip, stream) is None
    expected = clip_section.expected_codes(clip, stream, len(stream))
    codes = stream.codes()
    assert mixture_p_value(codes, np.tile(expected, (codes.size, 1))) > 1e-6
    photons = np.stack([clip_photons(clip, t, stream.photons_factor) for t in range(6)])
    blind = stream.sensor.pmf(photons, stream.exposure).reshape(-1, 2**stream.bits)
    assert mixture_p_value(codes, blind) < 1e-6
    section = clip_section.clip_section(clip)
    assert "exact distribution and its map of defects" in section
    assert "; defects: " in section
    if name == "measured":
        assert "dark_map rates.npy" in section
        np.save(tmp_path / "rates.npy", rates * 2)
        assert "rates.npy has changed since the stream was drawn" in clip_section.clip_section(clip)


def test_marks_are_left_out_where_nothing_exact_is_known(tmp_path):
    text = '[sensor]\nmodel = "BinarySPAD"\npde = 0.4\ndark_count_rate = 900.0\nbits = 1\n[defects]\n'
    clip = make_clip(tmp_path / "clip", frames=3, size=(12, 14))
    for cause in ("crosstalk", "afterpulse"):
        (tmp_path / "device.toml").write_text(f"{text}{cause} = 0.05\n")
        stream, _ = sense(clip, Sensing(str(tmp_path / "device.toml"), ppp=2.0, name=cause))
        assert "crosstalk and afterpulses" in str(clip_section.unexpected(clip, stream))
        words = clip_section.code_histogram(clip, stream)
        assert "no expectation is shown: crosstalk and afterpulses" in words
        assert f"defects: {cause} 0.05" in clip_section.stream_line(stream)
    grouped, _ = sense(clip, Sensing("spad-320x240", bits=2, ppp=2.0, name="grouped", group=True))
    assert "sums planes" in str(clip_section.unexpected(clip, grouped))
    unknown = replace(stream, meta=stream.meta | {"ppp_factor": None, "defects": {}})
    assert "light is not known" in str(clip_section.unexpected(clip, unknown))


def test_an_evaluation_says_what_its_scores_mean(folder):
    """Before format 2 the peak was the sensor's white and the factor unclamped; a page never mixes the two."""
    assert "peak = the sensor&#39;s white" in report.build(folder, title="All")
    path = folder / "evaluation.json"
    found = json.loads(path.read_text()) | {"peak": "2.5 x the stream's mean light", "remarks": ["<nano> was never"]}
    line = found["table"][0] | {"above_peak": 0.0961, "truth_psnr": 21.0, "near_truth": ["psnr_matched"]}
    path.write_text(json.dumps(found | {"table": [line]}))
    page = report.build(folder, title="All")
    for words in ("behind the clamp", "9.6 %", "20.00 ± 1.00 †", "within 3 dB of the truth", "&lt;nano&gt; was never"):
        assert words in page, words
    assert "as they were defined before" not in page


def test_average_is_the_mean_of_the_codes_around(folder):
    stream = Clip.open(folder / "square").stream(Clip.open(folder / "square").streams[0])
    codes = stream.codes(0, 5)
    shown = clip_section.stream_panels(stream, range(5))[1].frames
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


def test_clip_section_says_light_motion_model_and_error(tmp_path):
    """Numbers of the page are those of the clip: photons, factor, lux, motion, findings, error of every frame."""
    clip = write_clip(
        tmp_path / "lit", frames=4, height=20, width=24,
        render={"findings": [{"effect": "bounces", "chosen": "2", "size": "later ones <1 %"}]},
    )  # fmt: skip
    assert main(["sense", str(clip.path), "--ppp", "3.25", "--bits", "3"]) == 0
    stream = clip.stream(clip.streams[0])
    page = report.build(clip.path)
    assert f"{clip.mean_photons:.4g} photons per pixel and exposure as it is" in page
    assert f"3.25 photons per pixel (the clip&#39;s light × {stream.photons_factor:.4g}), as much as 1.313 lx" in page
    assert "2.6 e⁻ per pixel; 3 bit, QIS (multibit): quantum_efficiency 0.8 e-/photon" in page
    assert "<td>bounces</td><td>2</td><td>later ones &lt;1 %</td>" in page
    assert "Error of a frame (noise, blur, bounces left out): 0.01 rms in the unit of the radiance, worst 0.01" in page
    for words in ("light of the truth", "drawn, and expected from the light", "error of every frame"):
        assert words in page, words


def test_motion_is_that_of_the_pixels_that_move(folder):
    """The square moves 1 px, all else stands; half of the pixels unknown changes nothing."""
    assert clip_section.motion(Clip.open(folder / "square"), range(5)) == (1.0, 1.0)
    page = report.build(folder / "square")
    assert (
        "what moves (more than 0.1 px/frame) moves 1 px/frame on average; 99.9 % of all pixels at most 1 px/frame"
        in page
    )
    assert "rim = 1 px/frame" in page


def test_expected_histogram_is_the_mean_of_the_exact_distribution(tmp_path):
    """Even light: the expected shares are the sensor's pmf, and the drawn ones lie around them."""
    clip = write_clip(tmp_path / "even", radiance=np.full((4, 40, 50), 1.0))
    assert main(["sense", str(clip.path), "--ppp", "3.25", "--bits", "3", "-o", "mine"]) == 0
    stream = clip.stream("mine")
    expected = clip_section.expected_codes(clip, stream, 4)
    light = np.stack([clip_photons(clip, t, stream.photons_factor) for t in range(4)])
    exact = stream.sensor.pmf(light, stream.exposure).mean(axis=(0, 1, 2))
    np.testing.assert_allclose(expected, exact, atol=2e-3)  # every n-th pixel of light that falls off as cos^4
    assert expected.sum() == pytest.approx(1)


def test_a_data_set_is_a_table_and_a_clip_of_each_split(tmp_path):
    data = write_dataset(tmp_path / "tiny", {"train": 2, "val": 1, "test": 1})
    told: list[tuple[int, int]] = []
    page = report.build(data, progress=lambda done, total: told.append((done, total)))
    assert told == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert page.count('class="player"') == 3
    assert re.findall(r"<h2>(.*?)</h2>", page) == ["Data set tiny", "Clip test_0", "Clip train_0", "Clip val_0"]
    assert "4 clips; motion in the middle frame" in page


def test_studies_costs_and_validations_have_their_sections(tmp_path):
    rows = [{"model": "planes", "bits": 3, "psnr_db": 21.25}, {"model": "multibit", "bits": 3, "psnr_db": None}]
    study = {"clip": "fan", "ppp": 0.65, "rows": rows, "structure_function": [0.0, 1.0]}
    sweep = {"cells": [{"speed": 2.0, "best_bits": 3}], "studies": [study]}
    figure = {"figure": 1, "rows": [{"clip": "fan", "panels": [{"label": "CMOS 60 fps", "psnr_db": 18.9}]}]}
    cost = {"method": "nano", "seconds_per_frame": 0.25, "psnr_matched": None, "failure": None}
    checked = {"model": "QIS", "engine": "fast", "megapixels_per_second": 99.5, "times_numpy": 25.0, "cdf_error": 1e-7}
    checked |= dict.fromkeys(("p_value", "z_mean", "z_variance", "mismatches_per_million"))
    sensor = {"ok": False, "pixels": 9, "rows": [checked], "cases": [{"name": "ties", "found": "right", "ok": False}]}
    frame = {"scene": "drums", "level": 40.0, "psnr": 40.5, "stated_psnr": 40.25, "samples": 16, "bounces": 4}
    frame |= {"seconds": 0.5, "obvious_seconds": 6.0, "obvious_psnr": 40.0, "ratio": 12.0}
    render = {"ok": True, "median_ratio": 12.0, "height": 8, "width": 10, "engine": "llvm", "rows": [frame]}
    reading = ReadingReport(clip=250.5, mp4=20.0, clip_processor=300.0, mp4_processor=9.0, difference=0.01).to_dict()
    files = {"s/tradeoff": study, "w/tradeoff": sweep, "f/figure1": figure, "sensor": sensor, "render": render}
    files["reading"] = reading
    for name, content in (files | {"b/bench": {"setting": {"height": 64}, "costs": [cost]}}).items():
        path = tmp_path / f"{name}.json"
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps(content))
    page = report.build(tmp_path)
    for words in ("Study: s", "Study: w", "Study: f", "Cost of a frame: b", "21.25", "CMOS 60 fps", "best bits"):
        assert words in page, words
    assert "sensors, 9 pixels a draw: something is OUTSIDE its bounds" in page
    assert "rendering, frames of 8 × 10, llvm: everything is within its bounds" in page
    assert "windows of 11 × 128 × 128 in a clip of 65 × 512 × 1024: as quick as wanted (100/s, 5 times)" in page
    assert "250.5" in page
    assert "<td>ties</td><td>right</td><td>wrong</td>" in page


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
    """Standard output of a headless Chromium."""
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
    """At a phone's width: the scrubber moves frames, keys step, the slider reveals, nothing complains or sticks out."""
    import html

    page = tmp_path / "page.html"
    page.write_text(report.build(folder).replace("<head>", "<head>" + DRIVE, 1))
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
    """Dark and bright parts of the pictures are both there."""
    from PIL import Image

    page, picture = tmp_path / "page.html", tmp_path / "page.png"
    page.write_text(report.build(folder))
    chromium(f"--screenshot={picture}", page.as_uri(), profile=tmp_path / "profile")
    pixels = np.asarray(Image.open(picture).convert("L"))
    assert (pixels < 60).mean() > 0.005
    assert (pixels > 200).mean() > 0.2
