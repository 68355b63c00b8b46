"""Tests the page of qsim explore: its stored light, and in Chromium its histogram, keyboard, width and offline use."""

from __future__ import annotations

import base64
import json
import re

import numpy as np
import pytest
from browser import browser, needs_chromium
from clips import sliding_pattern, write_clip
from javascript import TEMPLATES, MiniRacer, Script
from stats import critical_z, mixture_p_value, per_check

from qsim import colour
from qsim.cli.program import main
from qsim.report import explore
from qsim.sensor import QIS, BinarySPAD, CountingSPAD
from qsim.streams.photons import clip_photons

SIZE = (40, 56)
ADDRESSES = {  # settings of the page, and the same here: (light, frames, sensor)
    "#device=quiver-paper&light=3.2&seed=1": (3.2, 1, QIS(0.8, 1.6, 0.2, 3)),
    "#model=QIS&bits=1&light=0.8&frames=4&start=3&efficiency=0.5&noise=0&gain=1&dark=100": (
        *(0.8, 4),
        QIS(0.5, 100.0, 0.0, 1),
    ),
    "#model=BinarySPAD&bits=3&light=5&frames=2&efficiency=0.4&dark=1000": (5.0, 2, BinarySPAD(0.4, 1000.0, 3)),
    "#model=CountingSPAD&bits=4&light=20&efficiency=0.35&dark=25&dead=5e-5": (
        *(20.0, 1),
        CountingSPAD(0.35, 25.0, 5e-5, 4),
    ),
}


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """Return a clip of light that varies by a factor of 30 and moves 1.5 px per frame."""
    flow = np.zeros((2, *SIZE), np.float32)
    flow[0] = 1.5
    radiance = sliding_pattern(9, *SIZE, seed=2) ** 3
    return write_clip(tmp_path_factory.mktemp("explore") / "slide", radiance=radiance, flow=flow)


@pytest.fixture(scope="module")
def written(clip):
    """Return the page of the clip, as the command writes it."""
    target = clip.path.with_name("page.html")
    assert main(["explore", str(clip.path), "-o", str(target), "--quiet"]) == 0
    return target


@pytest.fixture
def controls(clip):
    """The script of the page without its pictures: settings, and what changes them."""
    data = json.dumps(held(explore.explore_page(clip)))
    around = f"""
        const atob = () => "", location = {{ hash: "" }};
        const control = {{ textContent: {json.dumps(data)}, dataset: {{ from: 0, to: 1e6 }} }};
        const document = {{ getElementById: () => control }};
        class URLSearchParams {{
          constructor(text) {{ this.found = new Map(text.split("&").map(word => word.split("="))); }}
          has(name) {{ return this.found.has(name); }}
          get(name) {{ return this.found.get(name); }}
        }}
    """
    script = (TEMPLATES / "explore.js").read_text(encoding="utf-8").partition("\nfor (const name of NAMES) at(name)")[0]
    with MiniRacer() as engine:
        engine.eval(around)
        engine.eval(script)
        engine.eval("showControls = later = () => {}; readAddress()")
        yield Script(engine)


@pytest.fixture(scope="module")
def tab(tmp_path_factory):
    with browser(tmp_path_factory.mktemp("profile")) as page:
        yield page


def held(page: str) -> dict:
    """The data of a page."""
    return json.loads(re.search(r'<script id="data" type="application/json">(.*?)</script>', page, re.S)[1])


def test_the_page_holds_the_light_of_the_clip(clip, written):
    """The light that the page reads differs from that of the clip by the stated share of the photon noise at most."""
    data = held(written.read_text())
    steps = np.frombuffer(base64.b64decode(data["light"]), "<u2").reshape(data["frames"], data["height"], data["width"])
    read = data["brightest"] * (steps / data["steps"]) ** 2
    light = np.stack([clip_photons(clip, t, 1 / clip.mean_photons) for t in range(9)])
    ppp = 26.0
    share = explore.stored_light(clip).noise_share(ppp)
    assert np.all(np.abs(read - light) * ppp <= share * np.sqrt(light * ppp) + share**2)
    assert share < 0.001
    np.testing.assert_allclose(read, explore.stored_light(clip).light(), rtol=1e-12)
    assert data["motion"] == pytest.approx(1.5)


def test_large_pictures_are_reduced_by_a_whole_factor(tmp_path):
    """Blocks that do not fit are cut off, and the mean light per pixel stays."""
    radiance = np.random.default_rng(0).random((1, 301, 407))
    stored = explore.stored_light(write_clip(tmp_path / "large", radiance=radiance, relative=True))
    assert (stored.rows, stored.columns) == (2, 2)
    assert stored.steps.shape == (1, 150, 203)
    assert stored.light()[0, 3, 5] == pytest.approx(radiance[0, 6:8, 10:12].mean() / radiance.mean(), rel=2e-3)


def test_a_long_clip_shows_its_first_frames_and_says_so(tmp_path):
    page = explore.explore_page(write_clip(tmp_path / "long", frames=explore.FRAMES + 3, height=6, width=9))
    assert held(page)["frames"] == explore.FRAMES
    assert f"The first {explore.FRAMES} of {explore.FRAMES + 3} frames" in page
    assert held(page)["motion"] is None, "without flow the blur is unknown"
    assert held(page)["shutter"] == 1.0


def test_an_instant_has_no_blur(tmp_path):
    """Frames rendered without a shutter do not blur; the light of an exposure of a full frame time does."""
    assert held(explore.explore_page(write_clip(tmp_path / "sharp", frames=2, shutter=0.0)))["shutter"] == 0.0


def test_the_page_loads_nothing_and_escapes_the_name(clip, monkeypatch):
    monkeypatch.setattr(type(clip), "name", "<slide>")
    page = explore.explore_page(clip)
    assert "&lt;slide&gt;" in page
    assert "<slide>" not in page
    assert not re.search(r"(?:src|href)=|@import|url\(|fetch\(|XMLHttpRequest", page)
    assert not re.findall(r"https?://(?!www\.w3\.org/2000/svg)", page)


def test_every_control_has_a_label(written):
    page = written.read_text()
    controls = set(re.findall(r'<(?:input|select)[^>]* id="([^"]+)"', page))
    assert len(controls) == 11
    assert controls == set(re.findall(r'<label for="([^"]+)"', page))


def test_named_sensors_are_those_that_the_sliders_can_state():
    names = [one["name"] for one in explore.named_sensors(5e-4)]
    assert "quiver-physical" in names
    assert "spcm20a" in names
    assert "cmos-5.1e" not in names, "10 bits and an offset"


@pytest.mark.parametrize("count", [1, 2, 7, 999, 1001, 5000])
def test_pages_and_pictures_have_one_brightest_value(controls, count):
    light = np.random.default_rng(count).gamma(1.0, 3.0, count)
    assert controls.value(f"percentile({light.tolist()}, 0.999)") == pytest.approx(colour.peak(light), rel=1e-12)


def test_a_named_sensor_keeps_its_name_only_at_the_light_of_its_gain(controls):
    """Its gain is that of 3.25 photons in one frame: elsewhere the settings are the user's own."""

    def after(steps: str) -> list:
        return controls.value(f"({steps}, [state.device, state.light, state.frames])")

    assert after("0") == ["quiver-physical", 3.25, 1]
    assert after("change('start', 2)") == ["quiver-physical", 3.25, 1]
    assert after("change('light', 10)") == ["", 10, 1]
    assert after("takeDevice('quiver-published')") == ["quiver-published", 3.25, 1], "it comes with its light"
    assert after("change('frames', 2)") == ["", 3.25, 2]
    assert after("takeDevice('quiver-paper'), change('light', 10)") == ["quiver-paper", 10, 2], "its gain is 1"
    assert after("location.hash = '#device=quiver-published&light=3.25', readAddress()")[0] == "quiver-published"
    assert after("location.hash = '#device=quiver-published&light=9', readAddress()") == ["", 9, 1]
    assert controls.value("state.gain") == pytest.approx(0.5 * 7 / 3.25)


def test_a_black_clip_is_refused_and_nothing_is_written(tmp_path, capsys):
    write_clip(tmp_path / "black", radiance=np.zeros((2, 6, 9)))
    target = tmp_path / "page.html"
    assert main(["explore", str(tmp_path / "black"), "-o", str(target)]) == 2
    assert "no factor reaches" in capsys.readouterr().err
    assert not target.exists()


@needs_chromium
@pytest.mark.parametrize("address", ADDRESSES)
def test_the_histogram_is_that_of_the_exact_channel(clip, written, tab, address):
    """Codes drawn in the browser against the exact law of each pixel's light, and the page's own expectation."""
    ppp, count, sensor = ADDRESSES[address]
    tab.open(written, address)
    rows = np.array(
        tab.value(
            "[...document.querySelectorAll('#numbers tbody tr')].map(r => [...r.cells].map(c => Number(c.textContent)))"
        )
    )
    first = int(dict(part.split("=") for part in address[1:].split("&")).get("start", 1)) - 1
    photons = ppp * explore.stored_light(clip).light()[first : first + count].sum(axis=0)
    pmf = sensor.pmf(photons.ravel(), count * clip.exposure)
    checks = len(ADDRESSES)
    assert rows[:, 1].sum() == photons.size
    assert mixture_p_value(np.repeat(rows[:, 0], rows[:, 1].astype(int)).astype(int), pmf) > per_check(1e-6, checks)
    np.testing.assert_allclose(rows[:, 2], pmf.sum(axis=0), rtol=2e-3, atol=0.02)  # printed with two decimals
    often = rows[:, 3] > 5
    assert np.all(np.abs(rows[:, 1] - rows[:, 2])[often] < critical_z(checks=16 * checks) * rows[:, 3][often])
    assert tab.problems == []
    blur = 1.5 * (count - 1 + 1)
    assert tab.value("document.getElementById('blur').textContent") == f"{blur:g} px"


@needs_chromium
def test_sliders_move_by_keyboard_and_the_codes_follow(written, tab):
    tab.open(written, "#device=quiver-paper")
    before = tab.value("document.getElementById('numbers').textContent")
    tab.value("document.getElementById('bits').focus()")
    assert tab.value("document.activeElement.matches(':focus-visible')")
    assert tab.value("getComputedStyle(document.activeElement).outlineStyle") == "solid"
    tab.press("ArrowRight", 39)
    tab.wait("document.querySelectorAll('#numbers tbody tr').length === 16")
    assert tab.value("document.getElementById('bits').getAttribute('aria-valuetext')") == "4 bit"
    assert tab.value("document.getElementById('numbers').textContent") != before
    assert "bits=4" in tab.value("location.hash")
    assert "bits = 4" in tab.value("document.getElementById('file').textContent")
    tab.value("document.getElementById('play').click()")
    tab.wait("location.hash.includes('start=2') || location.hash.includes('start=3')")
    tab.value("document.getElementById('play').click()")
    assert tab.value("document.getElementById('play').textContent") == "play"


@needs_chromium
def test_controls_that_do_not_act_are_hidden(written, tab):
    def hidden() -> list[str]:
        return tab.value("[...document.querySelectorAll('.slider[hidden] input')].map(i => i.id)")

    tab.open(written, "#device=quiver-paper")
    assert hidden() == ["dead"]
    tab.value(
        "(s => { s.value = 'CountingSPAD'; s.dispatchEvent(new Event('change')); })(document.getElementById('model'))"
    )
    assert hidden() == ["noise", "gain"]
    assert tab.value("document.getElementById('device').value") == "", "no named sensor any more"


@needs_chromium
@pytest.mark.parametrize("dark", [False, True])
def test_a_phone_has_no_sideways_scroll_and_keeps_the_pictures_in_view(written, tab, dark):
    tab.open(written, "", width=390, height=844, dark=dark)
    assert tab.value("document.documentElement.scrollWidth") <= 390
    colours = tab.value("getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number)")
    assert (max(colours) < 60) if dark else (min(colours) > 200)
    tab.value("document.getElementById('dark').scrollIntoView({block: 'end'})")
    top, bottom = tab.value("(b => [b.top, b.bottom])(document.getElementById('codes').getBoundingClientRect())")
    assert 0 <= top < bottom < 844
