"""Comparing readouts: the same light, the same span, any number of clip frames per code."""

from __future__ import annotations

import json

import numpy as np
import pytest
from clips import write_clip
from sensor_files import QIS as QIS_FILE
from sensor_files import sensor_file

from qsim.cli.program import main
from qsim.optics.radiometry import RGB, LightLevel
from qsim.sensor.qis import QIS
from qsim.sensor.spike import SpikeCamera
from qsim.streams.photons import clip_photons
from qsim.streams.storing import write_stream
from qsim.streams.stream_info import StreamInfo
from qsim.studies.readouts import compare

EXACT = QIS(quantum_efficiency=1.0, dark_current=0.0, read_noise=0.0, bits=9)
SPIKE = SpikeCamera(quantum_efficiency=1.0, dark_current=0.0, threshold=100)


def test_the_light_of_a_span_is_its_mean_and_a_sensor_without_noise_finds_it(tmp_path):
    """An ideal counter errs by the light of its span and by shot noise, at one frame per code and at four."""
    clip = write_clip(tmp_path / "c", frames=12, height=7, width=9)
    clip.sense(EXACT, ppp=150.0, name="each")
    clip.sense(EXACT, ppp=150.0, slices=4, name="four")
    found = compare(clip)
    assert found.span == pytest.approx(4 / clip.frame_rate)
    assert found.instants == (2, 6, 10)
    light, each, four = found.rows
    assert (each.codes, four.codes, light.codes) == (4, 1, 4)
    truth = np.stack([clip_photons(clip, t, sharp=True) for t in found.instants])
    mean = np.stack([np.mean([clip_photons(clip, t + d) for d in (-2, -1, 0, 1)], axis=0) for t in found.instants])
    peak = 2.5 * clip.mean_photons
    assert light.psnr_db == pytest.approx(20 * np.log10(peak / np.sqrt(np.mean((mean - truth) ** 2))))
    blur = np.mean((mean - truth) ** 2)
    for row in (each, four):
        error = peak**2 / 10 ** (row.psnr_db / 10)
        shot = clip.mean_photons**2 / row.ppp  # at the mean light
        assert abs(error / (blur + shot) - 1) < 6 * np.sqrt(2 / truth.size)
    assert (each.ppp, four.ppp) == (pytest.approx(600.0), pytest.approx(150.0))
    assert each.megabytes_per_second == pytest.approx(9 * 7 * 9 * 2000 / 8e6)


def test_each_stream_is_scored_at_the_middle_of_its_own_codes(tmp_path):
    """A square moves on while codes of three frames, without noise, begin and end elsewhere than the span of seven."""
    light = np.full((21, 12, 33), 6.0)
    for t in range(21):
        light[t, 3:9, 4 + t : 10 + t] = 60.0
    clip = write_clip(tmp_path / "c", radiance=light, relative=True)
    for name, per_code in (("three", 3), ("seven", 7)):
        codes = light.reshape(-1, per_code, 12, 33).sum(axis=1).astype(np.uint16)
        rates = {"exposure": 5e-4 * per_code, "frame_rate": 2000 / per_code, "planes_per_code": per_code}
        level = LightLevel(factor=1.0, ppp=float(codes.mean()), before=1.0)
        write_stream(clip, name, codes, StreamInfo.of(EXACT, shape=codes.shape, light=level, **rates))
    found = compare(clip)
    assert found.instants == (3, 10, 17)
    scores = {row.stream: row.psnr_db for row in found.rows}
    for name, frames, starts in (("", 7, (0, 7, 14)), ("seven", 7, (0, 7, 14)), ("three", 6, (0, 6, 15))):
        error = [light[t : t + frames].mean(axis=0) - light[t + frames // 2] for t in starts]
        expected = 20 * np.log10(2.5 * light.mean() / np.sqrt(np.mean(np.square(error))))
        assert scores[name] == pytest.approx(expected, abs=0.01), name


@pytest.mark.parametrize("span", [1, 2, 5, 6, 11])
def test_noise_falls_with_the_span_of_a_static_scene(tmp_path, span: int):
    """Shot noise of a static scene: the mean square error of an ideal counter is light / frames, within six sigma."""
    still = np.broadcast_to(np.linspace(0.5, 1.5, 13 * 17).reshape(13, 17), (22, 13, 17))
    clip = write_clip(tmp_path / "c", radiance=still)
    clip.sense(EXACT, ppp=50.0, name="each")
    found = compare(clip, ["each"], span / clip.frame_rate)
    n = len(found.instants) * 13 * 17
    assert len(found.instants) == 22 // span
    error = (2.5 * 50) ** 2 / 10 ** (found.rows[1].psnr_db / 10)
    assert abs(error * span / 50 - 1) < 6 * np.sqrt(2.2 / n)
    assert found.rows[0].psnr_db > 200, "the light of a static scene has no error but rounding"


def test_spikes_come_near_the_light_they_count(tmp_path):
    """A static scene over all planes: a count of spikes errs by one spike at most, plus shot noise."""
    still = np.broadcast_to(np.linspace(0.5, 1.5, 11 * 7).reshape(11, 7), (60, 11, 7))
    clip = write_clip(tmp_path / "c", radiance=still)
    clip.sense(SPIKE, ppp=30.0, name="spike")
    (_, row) = compare(clip, span=60 / clip.frame_rate).rows
    error = (2.5 * 30) ** 2 / 10 ** (row.psnr_db / 10)  # photons^2 per plane
    rounding = (SPIKE.threshold / 60) ** 2 / 6  # two uniform ends of a count
    expected = rounding + 30 / 60
    assert abs(error / expected - 1) < 6 * np.sqrt(2.5 / 77)


def test_instants_end_with_the_stream_that_ends_first(tmp_path):
    """Codes of four frames leave the last three of eleven unseen: no stream is scored there."""
    clip = write_clip(tmp_path / "c", frames=11, height=5, width=8)
    clip.sense(EXACT, ppp=90.0, slices=4, name="four")
    clip.sense(EXACT, ppp=90.0, name="each")
    span = 1 / clip.frame_rate
    assert compare(clip, span=span).instants == tuple(range(8))
    assert compare(clip, ["each"], span).instants == tuple(range(11))
    assert compare(clip, span=8 * span).instants == (4,)
    with pytest.raises(ValueError, match=r"a span of 0\.0045 s; stream four covers 8 frames of 0\.0005 s: give a span"):
        compare(clip, span=9 * span)


def test_pixels_behind_filters_are_scored_in_their_light(tmp_path):
    """Of a scene at rest and a sensor without noise, the error is shot noise of each pixel's own light."""
    rng = np.random.default_rng(0)
    light = np.broadcast_to(rng.uniform(20, 60, (3, 1, 1)) * np.ones((6, 3, 40, 50)), (6, 3, 40, 50))
    clip = write_clip(tmp_path / "c", radiance=light, bands=list(RGB), relative=True)
    for mask in ("rggb", "rgbw"):
        clip.sense(EXACT, ppp=60.0, colour=mask, name=mask)
    rows = compare(clip).rows
    assert rows[0].psnr_db > 150, "nothing moves"
    bands = np.stack([clip_photons(clip, t) for t in range(6)]).mean((0, 2, 3))
    seen = {"rggb": bands[[0, 1, 1, 2]].mean(), "rgbw": np.mean([*bands, bands.sum()])}
    factor = 60.0 / bands.mean()
    assert {row.stream for row in rows[1:]} == set(seen)
    for row in rows[1:]:
        error = (2.5 * bands.mean()) ** 2 / 10 ** (row.psnr_db / 10)
        assert error == pytest.approx(seen[row.stream] / factor, rel=6 * np.sqrt(2 / 12000))


def test_the_command_prints_a_table_and_refuses_what_cannot_be(tmp_path, capsys):
    clip = write_clip(tmp_path / "c", frames=6, height=5, width=8)
    assert main(["compare", str(clip.path)]) == 2
    assert "has no streams to compare" in capsys.readouterr().err
    clip.sense(SPIKE, ppp=30.0, name="spike")
    clip.sense(EXACT, ppp=90.0, slices=3, name="slow")
    assert main(["compare", str(clip.path), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [(row["stream"], row["codes"]) for row in rows] == [("", 3), ("slow", 1), ("spike", 3)]
    assert main(["compare", str(clip.path), "--streams", "spike", "--span", "1e-3"]) == 0
    table = capsys.readouterr().out
    assert "c: 3 instants, 1 ms each, against the sharp light" in table
    assert "slow" not in table
    for words, message in [
        (["--span", "1"], "the clip has 6 frames of 0.0005 s: give a span between"),
        (["--span", "1e-9"], "a span of 1e-09 s"),
        (["--streams", "slwo"], "no stream 'slwo'"),
    ]:
        assert main(["compare", str(clip.path), *words]) == 2
        said = capsys.readouterr().err
        assert message in said
        assert said.count("\n") == 1


def test_the_dark_counts_of_hot_pixels_are_not_subtracted_from_all(tmp_path, capsys):
    """The score is that of the dark rate of the good pixels, and the command names what is not inverted."""
    rates = np.full((20, 20), 20.0)
    rates.flat[::101] = 2e5
    np.save(tmp_path / "rates.npy", rates)
    clip = write_clip(tmp_path / "c", radiance=np.full((11, 20, 20), 0.5), relative=True)
    stream = clip.sense(sensor_file(tmp_path, f'{QIS_FILE}dark_map = "rates.npy"\n', bits=4), ppp=3.0, name="hot")
    clip.sense(EXACT, ppp=3.0, name="perfect")
    found = compare(clip, span=11 / clip.frame_rate)
    assert found.remarks == ("hot: not inverted: dark rates of single pixels",)
    response = stream.sensor.with_dark_rate(20.0).response(stream.exposure)
    error = response.invert(stream.codes().mean(axis=0), 11) - 3.0
    expected = 20 * np.log10(2.5 * 3.0 / np.sqrt(np.mean(error**2)))
    assert {row.stream: row.psnr_db for row in found.rows}["hot"] == pytest.approx(expected, abs=0.01)
    assert main(["compare", str(clip.path)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == found.remarks[0]


def test_light_without_an_error_is_json_too(tmp_path, capsys):
    """One frame per code and no noise: the PSNR of the light is infinite, which JSON does not know."""
    clip = write_clip(tmp_path / "c", frames=4, height=5, width=8)
    clip.sense(EXACT, ppp=90.0, name="s")
    assert main(["compare", str(clip.path), "--json"]) == 0
    light, stream = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)["rows"]
    assert light["psnr_db"] is None
    assert stream["psnr_db"] > 0
