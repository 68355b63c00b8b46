"""Tests the section of a clip: light, motion, codes with their exact distribution, modelled effects, error."""

import re
from dataclasses import replace

import numpy as np
import pytest
from clips import colour_clip, describe_video, square_clip, write_clip
from stats import mixture_p_value

from qsim.cli.program import main
from qsim.clip.clip_info import RELATIVE
from qsim.clip.writer import ClipWriter
from qsim.optics.radiometry import RGB
from qsim.report import clip_section, report
from qsim.streams.clip import Clip
from qsim.streams.photons import clip_photons
from qsim.streams.sensing import Sensing
from qsim.streams.storing import sense

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
    """Chi-square accepts the expectation with the maps, and rejects that of the sensor without them."""
    (tmp_path / "device.toml").write_text(DEVICES[name])
    rates = np.random.default_rng(5).lognormal(7, 1, (40, 60))
    np.save(tmp_path / "rates.npy", rates)
    clip = square_clip(tmp_path / "clip", frames=6, size=(24, 33))
    stream, _ = sense(clip, Sensing(str(tmp_path / "device.toml"), ppp=2.0, name="mine"))
    clip = Clip.open(clip.path)
    assert clip_section.unexpected(clip, stream) is None
    expected = clip_section.expected_codes(clip, stream, len(stream))
    codes = stream.codes()
    assert mixture_p_value(codes, np.tile(expected, (codes.size, 1))) > 1e-6
    photons = np.stack([clip_photons(clip, t, stream.photons_factor) for t in range(6)])
    blind = stream.sensor.pmf(photons, stream.exposure).reshape(-1, 2**stream.bits)
    assert mixture_p_value(codes, blind) < 1e-6
    section = clip_section.clip_section(clip).body
    assert "exact distribution of the sensor and its map of defects" in section
    assert "; defects: " in section
    if name == "measured":
        assert "dark_map rates.npy" in section
        np.save(tmp_path / "rates.npy", rates * 2)
        assert "rates.npy has changed since the stream was drawn" in clip_section.clip_section(clip).body


@pytest.mark.parametrize(
    ("times", "said"),
    [
        ({"group": True}, ""),
        ({"group": True, "row_delay": 3e-6}, "; each row 3e-06 s later, down"),
        ({"exposures": (1.0, 0.25)}, "; exposures of 1, 0.25 of a code's time in turn"),
    ],
    ids=["planes", "rows", "exposures"],
)
def test_the_expected_codes_are_those_of_their_exposures(tmp_path, times, said):
    """Chi-square accepts the expectation, and rejects that of seven planes of equal, full light."""
    clip = square_clip(tmp_path / "clip", frames=43, size=(24, 33))
    stream, _ = sense(clip, Sensing("spad-320x240", bits=3, ppp=7.0, name="mine", **times))
    clip = Clip.open(clip.path)
    assert clip_section.unexpected(clip, stream) is None
    assert said in clip_section.stream_line(stream)
    expected = clip_section.expected_codes(clip, stream, len(stream))
    assert expected.sum() == pytest.approx(1)
    codes = stream.codes()
    assert mixture_p_value(codes, np.tile(expected, (codes.size, 1))) > 1e-6
    light = np.full((1, 1), stream.info.light.ppp)
    even = stream.sensor.pmf(light, stream.exposure).reshape(1, -1)
    assert mixture_p_value(codes, np.tile(even, (codes.size, 1))) < 1e-6


def test_no_expectation_is_shown_without_an_exact_one(tmp_path):
    text = '[sensor]\nmodel = "BinarySPAD"\npde = 0.4\ndark_count_rate = 900.0\nbits = 1\n[defects]\n'
    clip = square_clip(tmp_path / "clip", frames=3, size=(12, 14))
    for cause in ("crosstalk", "afterpulse"):
        (tmp_path / "device.toml").write_text(f"{text}{cause} = 0.05\n")
        stream, _ = sense(clip, Sensing(str(tmp_path / "device.toml"), ppp=2.0, name=cause))
        assert "crosstalk and afterpulses" in str(clip_section.unexpected(clip, stream))
        words = clip_section.code_histogram(clip, stream)
        assert "no expectation is shown: crosstalk and afterpulses" in words
        assert f"defects: {cause} 0.05" in clip_section.stream_line(stream)
    unknown = replace(stream, info=replace(stream.info, light=None, defects={}))
    assert "light is unknown" in str(clip_section.unexpected(clip, unknown))


def test_the_section_states_light_motion_model_and_error(tmp_path):
    """Numbers of the page are those of the clip: photons, factor, lux, motion, findings, error of every frame."""
    clip = write_clip(
        tmp_path / "lit",
        frames=4,
        height=20,
        width=24,
        render={"findings": [{"effect": "bounces", "chosen": "2", "size": "later ones <1 %"}]},
    )
    assert main(["sense", str(clip.path), "--ppp", "3.25", "--bits", "3"]) == 0
    stream = clip.stream(clip.streams[0])
    page = report.build_page(clip.path)
    assert f"{clip.mean_photons:.4g} photons per pixel and exposure" in page
    assert f"3.25 photons per pixel (the clip&#39;s light × {stream.photons_factor:.4g}), equal to 1.313 lx" in page
    assert "2.6 e⁻ per pixel; 3 bit, QIS (multibit): bits 3, dark_current 1.6 e-/s, gain 1 codes/e-" in page
    assert '<td>bounces</td><td class="number">2</td><td>later ones &lt;1 %</td>' in page
    assert "Error of a frame (noise, blur, omitted bounces): 0.01 rms in the unit of the radiance, worst 0.01" in page
    for words in ("light of the truth", "drawn, and expected from the light", "error of every frame"):
        assert words in page, words


def test_electrons_behind_colour_filters_are_those_of_the_mosaic(tmp_path):
    """A white pixel of four passes three bands, so 3.25 photons of equal bands make 3.25 x 0.8 x 6 / 4 electrons."""
    clip = colour_clip(tmp_path / "c", height=8, width=10)
    stream, line = sense(clip, Sensing("quiver-physical", ppp=3.25, bits=3, colour="rgbw", name="mosaic"))
    assert ", about 3.9 e⁻ per pixel with equal bands; 3 bit, QIS" in clip_section.stream_line(stream)
    assert "9.75 of all bands (about 3.9 e- with equal bands, photons of" in line


def test_motion_is_that_of_the_pixels_that_move(folder):
    """The square moves 1 px; all other pixels are still."""
    assert clip_section.motion(Clip.open(folder / "square"), range(5)) == (1.0, 1.0)
    page = report.build_page(folder / "square")
    assert (
        "moving pixels (more than 0.1 px/frame) move 1 px/frame on average; 99.9 % of all pixels at most 1 px/frame"
        in page
    )
    assert "rim = 1 px/frame" in page


def test_expected_histogram_is_the_mean_of_the_exact_distribution(tmp_path):
    """Even light: the expected shares are the pmf of the sensor."""
    clip = write_clip(tmp_path / "even", radiance=np.full((4, 40, 50), 1.0))
    assert main(["sense", str(clip.path), "--ppp", "3.25", "--bits", "3", "-o", "mine"]) == 0
    stream = clip.stream("mine")
    expected = clip_section.expected_codes(clip, stream, 4)
    light = np.stack([clip_photons(clip, t, stream.photons_factor) for t in range(4)])
    exact = stream.sensor.pmf(light, stream.exposure).mean(axis=(0, 1, 2))
    np.testing.assert_allclose(expected, exact, atol=2e-3)  # every n-th pixel of light that falls off as cos^4
    assert expected.sum() == pytest.approx(1)


def test_expected_codes_of_a_mosaic_hold_all_its_colours(tmp_path):
    """Every second pixel of a tile of 2 x 2 would be red, the brightest of these bands."""
    radiance = np.broadcast_to(np.array([3.0, 1.0, 0.3])[:, None, None], (2, 3, 128, 128))
    stream = write_clip(tmp_path / "c", radiance=radiance, bands=list(RGB)).sense(bits=3, ppp=3.25, colour="rggb")
    clip = Clip.open(tmp_path / "c")
    light = stream.colour_filter.mosaic(clip_photons(clip, 0, stream.photons_factor), stream.sensor.efficiency)
    exact = stream.sensor.pmf(light, stream.exposure).mean(axis=(0, 1))
    np.testing.assert_allclose(clip_section.expected_codes(clip, stream, 2), exact, atol=0.01)


def test_expected_codes_under_flicker_hold_all_its_phases(tmp_path):
    """A lamp of half the frame rate: frames 0, 4, ... 20 alone would all be dark."""
    strength = [0.5 + t % 2 for t in range(21)]
    flicker = {"light0": {"kind": "PulseWidth", "frequency": 1000.0, "strength": strength}}
    radiance = np.tile(2 * np.array(strength)[:, None, None], (1, 24, 33))
    clip = write_clip(tmp_path / "c", radiance=radiance, relative=True, flicker=flicker)
    stream = clip.sense(bits=3, ppp=3.25)
    light = np.stack([clip_photons(clip, t, stream.photons_factor) for t in range(21)])
    exact = stream.sensor.pmf(light, stream.exposure).mean(axis=(0, 1, 2))
    np.testing.assert_allclose(clip_section.expected_codes(clip, stream, 21), exact, atol=1e-9)


def test_numbers_of_the_first_frames_are_not_those_of_the_clip(tmp_path):
    """The square moves after frame 50 of 60, and a page reads 48 of them."""
    size = (8, 24)
    meta = {"shape": [60, *size], "frame_rate": 2000.0, "exposure": 5e-4, "radiance_unit": RELATIVE}
    with ClipWriter(tmp_path / "late", meta) as writer:
        for t in range(60):
            left = 2 + max(t - 50, 0)
            radiance = np.full(size, 0.1, np.float32)
            flow = np.zeros((2, *size), np.float32)
            radiance[2:6, left : left + 4] = 1.0
            flow[0, 2:6, left : left + 4] = t >= 50
            writer.add(t, radiance, truth={"flow": flow, "flow_back": -flow, "valid": np.ones(size, bool)})
    stream = Clip.open(tmp_path / "late").sense(bits=3, ppp=3.25, name="mine")
    body = clip_section.clip_section(Clip.open(tmp_path / "late")).body
    which = "in the first 48 of 60"
    assert f"Motion {which} frames: nothing moves" in body
    assert body.count("nothing moves") == 1
    assert f"motion between successive frames, all pixels {which} frames" in body
    assert f"light of the recorded video, all pixels {which} frames" in body
    assert f"codes of mine {which} frames: drawn" in body
    np.save(tmp_path / "v.npy", np.full(stream.shape, 3.25, np.float32))
    describe_video(tmp_path / "v.json", source=str(stream.path))
    section = report.restored_section(tmp_path / "v.json")
    assert re.search(rf"with a PSNR of [\d.]+ dB {which} frames\.$", section.story)
    assert section.facts[0].what == f"PSNR of v {which} frames"
