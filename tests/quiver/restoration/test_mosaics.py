"""Tests restoring of mosaics: the parts, every classical method, files, defects, scores, commands."""

import json
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from clips import colour_clip

import quiver
from qsim.cli import main as qsim_main
from qsim.report.views import open_source
from qsim.sensor.colour_filter import MASKS, ColourFilter
from qsim.sensor.demosaicing import demosaic
from qsim.sensor.qis import QIS
from quiver.baselines import METHODS
from quiver.cli import main
from quiver.data.codes import array_codes, filled, stream_codes
from quiver.restoration.mosaics import fill_mosaic, places
from quiver.restoration.restorers import restorer

SENSOR = QIS(0.8, 5.0, 0.2, 3)


@pytest.fixture
def stream(tmp_path):
    return colour_clip(tmp_path / "c", frames=12, height=17, width=21).sense(SENSOR, ppp=6.0, colour="rggb", name="s")


@pytest.mark.parametrize("mask", [MASKS["rggb"], MASKS["quad"], MASKS["rgbw"], ("RGB",), ("RGW", "BGR")])
def test_places_are_the_pixels_of_one_colour(mask):
    rng = np.random.default_rng(0)
    filters = ColourFilter(mask)
    values = rng.integers(0, 8, (2, 9, 11))
    codes = replace(array_codes(values, SENSOR, 1e-3), colour=filters, ppp=2.0)
    again = np.full(values.shape, -1)
    for (i, j), part in places(codes):
        rows, columns = filters.tile
        assert part.colour is None
        again[:, i::rows, j::columns] = part.read(0, 2)
        assert part.shape == (2, *part.read(0, 2).shape[1:])
        assert part.ppp == pytest.approx(6.0 if mask[i][j] == "W" else 2.0)
    np.testing.assert_array_equal(again, values)


@pytest.mark.parametrize("method", ["naive", "moment", "likelihood"])
def test_methods_of_single_pixels_need_no_places(stream, method):
    """Such a method restores the mosaic as it is: then demosaicing its light is the same."""
    codes = stream_codes(stream)
    mosaic = restorer(method).restore(replace(codes, colour=None))
    expected = np.stack([demosaic(frame, codes.colour, 0.8) for frame in mosaic])
    found = quiver.restore(stream, method)
    assert found.shape == (12, 3, 17, 21)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(restorer(method).restore(codes, 3, 7), found[3:7], rtol=1e-5, atol=1e-5)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:mergenet ")  # measured or not for such streams
@pytest.mark.parametrize("method", [*METHODS, "mergenet"])
def test_every_method_restores_colours(stream, method):
    truth = stream.truth()
    found = quiver.restore(stream, method)
    np.testing.assert_array_equal(np.argsort(found.mean((0, 2, 3))), np.argsort(truth.mean((0, 2, 3))))
    if method != "naive":  # it takes codes as linear: bright bands saturate
        grey = np.broadcast_to(truth.mean(axis=1, keepdims=True), truth.shape)
        assert np.mean((found - truth) ** 2) < np.mean((grey - truth) ** 2)


def test_places_without_defective_pixels_need_no_good_one():
    """Frames of one row lack half of the tile's places; a map was refused there with `all 0 pixels are marked`."""
    codes = replace(array_codes(np.full((3, 1, 8), 5, np.uint8), SENSOR, 1e-3), colour=ColourFilter(MASKS["rggb"]))
    bad = np.zeros((1, 8), bool)
    bad[0, 2] = True
    np.testing.assert_array_equal(filled(codes, bad).read(0, 3), codes.read(0, 3))
    with pytest.raises(ValueError, match="all 4 pixels are marked as defective"):
        filled(codes, np.arange(8)[None] % 2 == 0)


def test_defective_pixels_are_filled_by_their_colour(stream):
    codes = stream_codes(stream)
    bad = np.zeros(codes.shape[1:], bool)
    bad[8, 10] = bad[3, 4] = True
    painted = np.zeros(codes.shape, np.int64)
    painted[:, ::2, ::2] = 7  # red pixels alone
    found = filled(replace(codes, read=lambda a, b: painted[a:b]), bad).read(0, 2)
    assert found[:, 8, 10].tolist() == [7, 7], "a red pixel"
    assert found[:, 3, 4].tolist() == [0, 0], "a green pixel between red ones"


def test_commands_restore_show_score_and_check(stream, tmp_path, capsys):
    clip = stream.clip.path
    out = tmp_path / "video.npy"
    assert main(["restore", str(clip), "-o", str(out), "--method", "moment", "--json"]) == 0
    video = np.load(out)
    described = json.loads(out.with_suffix(".json").read_text())
    np.testing.assert_array_equal(video, quiver.restore(stream, "moment"))
    assert described["shape"] == [12, 3, 17, 21]
    assert described["colour"]["mask"] == ["RG", "GB"]
    assert open_source(out).views["values"].picture(3).shape == (17, 21, 3)
    assert open_source(clip).views["average"].picture(3).shape == (17, 21, 3)
    assert qsim_main(["check", str(out)]) == 0
    assert qsim_main(["report", str(tmp_path), "-o", str(tmp_path / "page.html")]) == 0
    score = quiver.score(video, stream)
    table = tmp_path / "table"
    line = ["evaluate", str(clip), "-o", str(table), "--split", "all", "--methods", "moment", "--stream", "s"]
    capsys.readouterr()
    assert main(line) == 0
    row = json.loads((table / "rows.jsonl").read_text())
    assert row["failure"] is None
    assert row["score"]["psnr"] == pytest.approx(score.psnr, abs=1e-6)
    assert np.load(next((table / "crops").glob("*moment-*.npy"))).shape[0] == 3


def test_small_frames_and_other_shapes_are_refused(tmp_path):
    clip = colour_clip(tmp_path / "c", frames=2, height=3, width=9)
    stream = clip.sense(SENSOR, ppp=6.0, colour="quad")
    with pytest.raises(ValueError, match="3 x 9 px are smaller than the mask's 4 x 4"):
        quiver.restore(stream, "naive")
    with pytest.raises(ValueError, match=r"video has shape \[2, 3, 9\], stream \[2, 3, 3, 9\]"):
        quiver.score(np.ones((2, 3, 9)), stream)


def test_raw_codes_of_a_sensor_with_filters_are_restored_in_colour(stream, tmp_path):
    """A bare array, and the same codes imported: the sensor's file states the mask, and a map of dead pixels."""
    text = '[sensor]\nmodel = "QIS"\nquantum_efficiency = 0.8\ndark_current = 5.0\nread_noise = 0.2\nbits = 3\n'
    (tmp_path / "my.toml").write_text(f'{text}[defects]\ndead_map = "dead.npy"\n[colour]\nmask = "rggb"\n')
    dead = np.zeros(stream.shape[1:], np.uint8)
    dead[8, 10] = dead[3, 4] = 1
    np.save(tmp_path / "dead.npy", dead)
    np.save(tmp_path / "raw.npy", stream.codes(0, 12))
    own = ["--sensor", str(tmp_path / "my.toml"), "--frame-rate", repr(1 / stream.exposure)]
    words = ["convert", str(tmp_path / "raw.npy"), str(tmp_path / "imported"), *own, "--layout", "codes", "--bits", "3"]
    assert qsim_main(words) == 0
    expected = restorer("moment").restore(filled(stream_codes(stream), dead != 0))
    for source, options in (("raw.npy", own), ("imported.npy", [])):
        out = tmp_path / f"restored_{source}"
        assert main(["restore", str(tmp_path / source), "-o", str(out), "--method", "moment", *options]) == 0
        found = np.load(out)
        assert found.shape == (12, 3, 17, 21)
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(quiver.restore(tmp_path / "imported.npy", "moment"), found)
    (tmp_path / "dead.npy").unlink()
    with pytest.warns(UserWarning, match=r"imported\.npy: its hot and dead pixels are not filled"):
        quiver.restore(tmp_path / "imported.npy", "moment")


def test_one_filter_is_refused_before_any_work(tmp_path, capsys):
    """It does not determine three bands, which was noticed after the last frame."""
    stream = colour_clip(tmp_path / "c", frames=3).sense(SENSOR, ppp=6.0, colour="red", name="red")

    def fill(*given):
        pytest.fail("a band was restored")

    with pytest.raises(ValueError, match="the mask R does not determine three bands"):
        fill_mosaic(fill, stream_codes(stream), np.zeros((3, 3, 7, 9), np.float32), 0, None)
    out = tmp_path / "out" / "video.npy"
    assert main(["restore", str(stream.path), "-o", str(out), "--method", "naive"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not out.parent.exists()


def test_the_memory_of_a_mosaic_does_not_grow_with_its_frames(tmp_path):
    """`out` may be a file: all frames were held twice beside it."""
    stream = colour_clip(tmp_path / "c", frames=40, height=64, width=64).sense(SENSOR, ppp=6.0, colour="rggb", name="m")
    codes = stream_codes(stream)

    def fill(place, light, first, progress):
        light += 1.0

    peaks = []
    for frames in (1, 5, 40):  # the first one imports, and makes tables that stay
        out = np.zeros((frames, 3, 64, 64), np.float32)
        tracemalloc.start()
        fill_mosaic(fill, codes, out, 0, None)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert (out > 0).all()
    assert peaks[2] - peaks[1] < 35 * 64 * 64 * 4 / 4  # a quarter of the light of the other frames
