"""Exposure schedules: the law of every code, gates in slices, redraw, and refusals."""

from __future__ import annotations

import numpy as np
import pytest
from clips import write_clip
from stats import assert_mean

from qsim.dataset.checking import redraw
from qsim.formats.challenge import bands_of
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.defects.defect_table import Defects
from qsim.sensor.defects.fixed_pattern import FixedPattern
from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD
from qsim.streams.exposures import gate
from qsim.streams.preparation import prepare
from qsim.streams.sensing import Sensing
from qsim.streams.storing import replay, sense
from qsim.studies.readouts import compare

SCHEDULE = (1.0, 0.25, 0.0625)
SENSORS = {
    "QIS": (QIS(0.8, 800.0, 0.2, 3), {}),
    "QIS of ten bits": (QIS(0.8, 800.0, 0.2, 10), {}),
    "plane": (BinarySPAD(0.5, 900.0, bits=1), {}),
    "sum of the clip's planes": (BinarySPAD(0.5, 900.0, bits=2), {"group": True, "bits": 2}),
    "counting": (CountingSPAD(pde=0.5, dark_count_rate=900.0, dead_time=4e-5, bits=5), {}),
    "rows": (QIS(0.8, 800.0, 0.2, 3), {"row_delay": 2e-5, "row_order": "left"}),
    "defects": (QIS(0.8, 800.0, 0.2, 3), {"defects": Defects(FixedPattern(prnu=0.1, dead=0.05))}),
}


def test_a_gate_takes_the_middle_of_the_slices():
    """Against a count of many moments, over random shares and numbers of slices."""
    rng = np.random.default_rng(3)
    moments = (np.arange(100_000) + 0.5) / 100_000
    for _ in range(50):
        share = 1 - rng.random()
        slices = int(rng.integers(1, 20))
        inside = np.abs(moments - 0.5) <= share / 2
        counted = np.bincount((moments[inside] * slices).astype(int), minlength=slices) * slices / moments.size
        np.testing.assert_allclose(gate(share, slices), counted, atol=3e-5 * slices)
        assert gate(share, slices).sum() == pytest.approx(share * slices, rel=1e-12)
    np.testing.assert_array_equal(gate(1.0, 5), np.ones(5))
    np.testing.assert_allclose(gate(0.4, 5), [0, 0.5, 1, 0.5, 0], atol=1e-12)


@pytest.mark.parametrize("kind", SENSORS)
def test_streams_keep_their_schedule(tmp_path, kind):
    """Stored, replayed and drawn again from the description alone; another schedule is another stream."""
    sensor, how = SENSORS[kind]
    clip = write_clip(tmp_path / "clip", frames=13, height=7, width=9)
    wanted = Sensing(sensor, ppp=6.0, name="s", exposures=SCHEDULE, **how)
    stream, line = sense(clip, wanted)
    assert "exposures of 1, 0.25, 0.0625 of a code's time in turn" in line
    np.testing.assert_allclose(stream.exposures, stream.exposure * np.resize(SCHEDULE, len(stream)))
    for t in range(len(stream)):
        drawn, kept = replay(clip, stream, t)
        np.testing.assert_array_equal(drawn, kept)
    (found,) = redraw(stream.path)
    assert (found.differ, found.why) == (0, None)
    assert sense(clip, wanted)[0].info == stream.info
    with pytest.raises(FileExistsError, match="exists with other settings"):
        sense(clip, Sensing(sensor, ppp=6.0, name="s", exposures=SCHEDULE[:2], **how))


@pytest.mark.parametrize("kind", ["QIS", "plane", "sum of the clip's planes", "counting"])
def test_codes_have_the_law_of_their_exposure(tmp_path, kind):
    """Flat light: light, dark counts and dead time are those of the share; the mean code is the exact one."""
    sensor, how = SENSORS[kind]
    flat = np.full((9, 41, 53), 1.0)
    clip = write_clip(tmp_path / "flat", radiance=flat, relative=True)
    draw = prepare(clip, Sensing(sensor, ppp=6.0, exposures=SCHEDULE, **how))
    codes = draw.frames(clip, 0, len(draw.exposures(clip)))
    for t, drawn in enumerate(codes):
        share = SCHEDULE[t % 3]
        light = np.array([6.0 * share])
        exposure = clip.exposure * draw.planes * share
        mean = sensor.mean(light, exposure)
        variance = sensor.variance(light, exposure)
        assert_mean(drawn, float(mean[0]), float(variance[0]), checks=len(codes))


def test_a_full_exposure_is_a_stream_without_schedule(tmp_path):
    clip = write_clip(tmp_path / "clip", frames=5, height=7, width=9)
    for kind in ("QIS", "sum of the clip's planes", "counting"):
        sensor, how = SENSORS[kind]
        one, other = (
            prepare(clip, Sensing(sensor, ppp=3.0, exposures=shares, **how)).frames(clip, 0, 1)
            for shares in (None, (1.0,))
        )
        np.testing.assert_array_equal(one, other)


def test_the_truth_of_light_beyond_white_is_not_cut_off(tmp_path):
    """Photons of a full exposure, fifty times what the sensor resolves."""
    bright = np.full((4, 5, 6), 0.02)
    bright[:, 2, 3] = 50.0
    clip = write_clip(tmp_path / "clip", radiance=bright, relative=True)
    stream, _ = sense(clip, Sensing(QIS(0.8, 1.6, 0.2, 3), ppp=20.0, exposures=SCHEDULE))
    assert stream.truth().max() > 50 * stream.sensor.white(stream.exposure)
    np.testing.assert_allclose(stream.truth()[:, 2, 3] / stream.truth()[:, 0, 0], 50 / 0.02, rtol=1e-3)


@pytest.mark.parametrize(
    ("shares", "message"),
    [
        ((1.0, 0.0), r"a number from 1e-06 to 1, got \(1\.0, 0\.0\)"),
        ((-0.5,), r"got \(-0\.5,\)"),
        ((1.0, 1.5), r"got \(1\.0, 1\.5\)"),
        ((float("nan"),), r"got \(nan,\)"),
        ((), r"got \(\)"),
    ],
)
def test_impossible_schedules_are_refused(shares, message):
    with pytest.raises(ValueError, match=f"exposures: expected a list of 1 to 256: .*{message}"):
        Sensing(QIS(0.8, 1.6, 0.2, 3), exposures=shares)


def test_pixels_that_remember_are_refused(tmp_path):
    clip = write_clip(tmp_path / "clip", frames=4, height=4, width=5)
    plane = BinarySPAD(0.5, 900.0, bits=1)
    with pytest.raises(ValueError, match="exposures: afterpulses and carried dead time need codes of equal exposure"):
        prepare(clip, Sensing(plane, exposures=SCHEDULE, defects=Defects(afterpulse=0.1)))
    with pytest.raises(ValueError, match="exposures: slices of a counting pixel need codes of equal exposure"):
        prepare(clip, Sensing(SENSORS["counting"][0], exposures=SCHEDULE, slices=2))


@pytest.mark.parametrize("how", [{"exposures": SCHEDULE}, {"row_delay": 2e-5}])
def test_what_takes_equal_exposures_read_at_once_refuses_others(tmp_path, how):
    clip = write_clip(tmp_path / "clip", frames=6, height=4, width=5)
    for name in ("red", "green", "blue"):
        sense(clip, Sensing(BinarySPAD(0.5, 900.0, bits=1), name=name, **how))
    for run, what in (
        (lambda: compare(clip), "a comparison of readouts"),
        (lambda: bands_of(clip, 4), "a cube of the challenge"),
    ):
        with pytest.raises(ValueError, match=f"{what} needs rows read at once and equal exposures; leave this stream"):
            run()
