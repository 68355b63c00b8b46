"""Tests the moving pictures: codes as light on the tone curve of the truth, scores, errors, ground truth."""

from __future__ import annotations

import numpy as np
import pytest
from clips import colour_clip, write_clip
from sensor_files import SPAD, sensor_file

from qsim import colour
from qsim.cli.program import main
from qsim.clip.clamped_error import white_in
from qsim.clip.clip_info import RELATIVE
from qsim.clip.writer import ClipWriter
from qsim.report import panels, views
from qsim.sensor.colour_filter import MASKS, ColourFilter
from qsim.streams.clip import Clip
from qsim.streams.photons import clip_photons


@pytest.fixture(scope="module")
def stream(tmp_path_factory):
    """Return a 4-bit stream of low light: most codes are 0, 1 and 2 of 15."""
    clip = write_clip(tmp_path_factory.mktemp("panels") / "dim", frames=14)
    assert main(["sense", str(clip.path), "--sensor", "quiver-paper", "--bits", "4", "--ppp", "1.3", "-o", "dim"]) == 0
    return clip.stream("dim")


def test_codes_are_on_the_tone_curve_of_the_truth(stream):
    """A code is drawn as the light at which it is the mean code: codes of few photons are not nearly black."""
    clip = Clip.open(stream.path.parents[1])
    frames = range(5)
    truth = panels.truth_photons(clip, stream, frames)
    shown = panels.stream_panels(stream, frames, truth)[0].frames
    codes = stream.codes(0, 5)
    light = stream.sensor.response(stream.exposure).invert(codes, 1)
    assert np.array_equal(shown, colour.tone(light, colour.peak(truth)))
    assert shown[codes == 1].mean() > 3 * colour.code_levels(codes, 15)[codes == 1].mean()


def test_the_average_is_the_mean_of_the_codes_around(stream):
    """Frame 0 has the frames 0 ... 5, frame 6 the frames 1 ... 11."""
    response = stream.sensor.response(stream.exposure)
    codes = stream.codes()
    truth = panels.truth_photons(Clip.open(stream.path.parents[1]), stream, range(14))
    shown = panels.stream_panels(stream, range(14), truth)[1].frames
    for t, near in ((0, codes[:6]), (6, codes[1:12])):
        light = response.invert(near.mean(axis=0), 11)
        assert np.array_equal(shown[t], colour.tone(light, colour.peak(truth)))


def test_scores_are_psnr_below_white_clamped_there(stream):
    clip = Clip.open(stream.path.parents[1])
    truth = panels.truth_photons(clip, stream, range(14))
    np.testing.assert_allclose(truth[3], clip_photons(clip, 3, stream.photons_factor, sharp=True))
    light = np.full_like(truth, truth.mean())
    white = white_in(truth)
    error = np.minimum(light, white) - np.minimum(truth, white)
    expected = 10 * np.log10(white**2 / np.mean(error**2))
    assert panels.score(light, truth) == f"{expected:.1f} dB"
    assert panels.score(truth, truth) == panels.score(truth, None) == ""


def test_good_pixels_are_as_bright_as_the_truth_beside_hot_ones(tmp_path):
    """1 % of hot pixels hold nearly all dark counts of the map; captions name what is not inverted."""
    rates = np.full((40, 40), 20.0)
    rates.flat[::101] = 2e5
    np.save(tmp_path / "rates.npy", rates)
    clip = write_clip(tmp_path / "even", radiance=np.full((11, 40, 40), 0.5), relative=True)
    path = sensor_file(tmp_path, f'{SPAD}dark_map = "rates.npy"\ncrosstalk = 0.001\n', bits=4)
    hot = clip.sense(path, ppp=3.0, name="hot")
    frames = range(4, 7)
    shown = panels.stream_panels(hot, frames, panels.truth_photons(clip, hot, frames))
    for panel in shown:
        assert panel.caption.endswith("; not inverted: crosstalk, dark rates of single pixels")
    assert np.median(shown[1].frames) > 235, "the truth is 255; 2.5 of 3 photons too low is 113"


def test_codes_without_a_rising_response_are_shown_as_they_are(tmp_path):
    """Dark counts saturate every code: no light can be stated, and no score."""
    clip = write_clip(tmp_path / "blind", frames=3)
    (tmp_path / "blind.toml").write_text('[sensor]\nmodel = "BinarySPAD"\npde = 0.4\ndark_count_rate = 1e9\nbits = 1\n')
    assert main(["sense", str(clip.path), "--sensor", str(tmp_path / "blind.toml"), "--ppp", "1", "-o", "blind"]) == 0
    blind = clip.stream("blind")
    codes, mean = panels.stream_panels(blind, range(3), panels.truth_photons(clip, blind, range(3)))
    assert np.array_equal(codes.frames, colour.code_levels(blind.codes(), 1))
    assert codes.score == mean.score == ""


def test_a_code_of_several_frames_has_no_truth_of_its_own(tmp_path):
    clip = write_clip(tmp_path / "planes", frames=14)
    assert (
        main(["sense", str(clip.path), "--sensor", "spad-320x240", "--bits", "2", "--group", "--ppp", "3", "-o", "sum"])
        == 0
    )
    assert panels.truth_photons(clip, clip.stream("sum"), range(4)) is None


def test_errors_are_red_above_and_blue_below():
    truth = np.full((1, 4, 6), 2.0)
    light = truth.copy()
    light[0, 0, 0] = 9.0
    light[0, 0, 1] = 0.0
    shown = panels.error_panel("x", light, truth).frames
    assert np.array_equal(shown[0, 2, 2], [255, 255, 255])
    assert shown[0, 0, 0, 0] > 200 > 100 > shown[0, 0, 0, 2]
    assert shown[0, 0, 1, 2] > 200 > 100 > shown[0, 0, 1, 0]


def test_ground_truth_lies_over_the_light(tmp_path):
    """Flow, depth, bodies and hidden points of a clip; what is even everywhere has no picture."""
    size = (8, 11)
    rng = np.random.default_rng(1)
    flow = np.zeros((2, *size), np.float32)
    flow[0, :, 5:] = 3.0
    depth = np.repeat(np.linspace(1, 4, 8, dtype=np.float32)[:, None], 11, axis=1)
    body = np.where(np.arange(11) > 4, 1, -1)[None].repeat(8, axis=0).astype(np.int32)
    valid = np.ones(size, bool)
    valid[2] = False
    meta = {"shape": [2, *size], "frame_rate": 2000.0, "exposure": 5e-4, "radiance_unit": RELATIVE, "camera": None}
    with ClipWriter(tmp_path / "all", meta) as writer:
        for t in range(2):
            truth = {"flow": flow, "flow_back": -flow, "depth": depth, "body_id": body, "valid": valid}
            writer.add(t, rng.random(size), truth=truth)
    found, largest, speed = panels.truth_panels(Clip.open(tmp_path / "all"), range(2))
    assert [panel.caption.split(",")[0].split(":")[0] for panel in found] == [
        "recorded video",
        "flow",
        "depth",
        "bodies",
        "red",
    ]
    assert largest == pytest.approx(3.0)
    assert speed.max() == pytest.approx(3.0)
    light, motion, near, bodies, hidden = (panel.frames[0].astype(int) for panel in found)
    still = (4, 1)
    moving = (4, 8)
    assert np.ptp(motion[still]) == 0, "grey where nothing moves"
    assert motion[moving][0] - motion[moving][1] > 50, "red to the right"
    assert near[0].sum() > near[-1].sum(), "near is bright"
    assert np.ptp(bodies[still]) == 0
    assert np.ptp(bodies[moving]) > 40
    assert hidden[2, 3, 0] - hidden[2, 3, 1] > 50
    assert np.ptp(hidden[still]) == 0
    dark = np.unravel_index(light.argmin(), size)
    bright = np.unravel_index(light.argmax(), size)
    assert motion[bright].max() > motion[dark].max()


def test_a_still_clip_of_one_body_shows_its_flow_only(tmp_path):
    clip = write_clip(tmp_path / "plain", frames=2, flow=np.zeros((2, 36, 44), np.float32))
    found, largest, _ = panels.truth_panels(clip, range(2))
    assert [panel.caption for panel in found][1:] == ["flow, full colour at 0.5 px/frame"]
    assert largest == 0.5


@pytest.mark.parametrize("name", ["red", "green", "rggb"])
def test_a_stream_behind_one_filter_is_shown_in_grey(tmp_path, name):
    """What one filter lets pass is compared with the light behind it; a mosaic becomes colours."""
    clip = colour_clip(tmp_path / "c", frames=12, height=9, width=11)
    stream = clip.sense("spad512s", bits=1, ppp=0.4, colour=name, name="s")
    frames = range(3, 6)
    codes, mean = panels.stream_panels(stream, frames, panels.truth_photons(clip, stream, frames))
    assert ("demosaiced" in mean.caption) == (name == "rggb")
    assert codes.score.endswith("dB")
    assert mean.score.endswith("dB")
    average = views.open_source(stream.path.with_suffix(".json")).views["average"]
    assert ("demosaiced" in average.declared) == (name == "rggb")


def test_a_wide_mosaic_keeps_all_its_colours(tmp_path):
    """Every second pixel of a tile of 2 x 2 is red, so 520 columns are reduced by 3; a demosaiced picture by 2."""
    clip = colour_clip(tmp_path / "c", frames=2, height=8, width=520)
    stream = clip.sense("spad512s", bits=1, ppp=0.4, colour="rggb")
    codes, mean = panels.stream_panels(stream, range(2))
    assert codes.frames.shape == (2, 3, 174)
    assert mean.frames.shape == (2, 4, 260, 3)
    for name in ("rggb", "quad"):
        filters = ColourFilter(MASKS[name])
        rows, columns = filters.tile
        colours = np.array([[ord(letter) for letter in row] for row in filters.mask], np.uint8)
        mosaic = np.tile(colours, (1, 24 // rows, 528 // columns))
        seen = panels.fit(mosaic, filters)
        for letter in b"RGB":
            assert (seen == letter).mean() == pytest.approx((mosaic == letter).mean()), (name, chr(letter))


def test_tall_pictures_show_as_many_frames_as_browsers_draw():
    """A panel holds its frames below each other; wide pictures are reduced before that."""
    assert panels.chosen_frames(60, 24, 33) == range(48)
    assert panels.chosen_frames(60, 768, 512) == range(41)
    assert panels.chosen_frames(60, 1536, 1024) == range(41)
    assert panels.chosen_frames(5, 768, 512) == range(5)
