"""Tests the comparison with the naive loop: its light, the reference's variance, and the verdict."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from small_scenes import plate, renderer

from qsim.rendering.budget import Budget
from qsim.scene import Spin, SunSky
from qsim.studies.validation import rendering
from qsim.studies.validation.rendering import FRAME, NaiveLoop, RenderReport, RenderRow, Target

ROW = RenderRow("a/0", 40.0, 1024, 40.2, 3.0, False, 32, True, 4, 40.6, 40.1, 0.25)


def test_the_naive_loop_renders_the_same_scene():
    """Camera, film and sampler are those of Mitsuba; both means agree within their errors."""
    views = renderer(plate(Spin((0, 0, 1), 200.0), light=SunSky()), budget=Budget(128, 16))
    ours = views.frame(2, with_truth=False)
    theirs = NaiveLoop(views).frame(2, 64)
    assert theirs.shape == ours.radiance.shape
    difference = np.sqrt(np.mean((theirs - ours.radiance) ** 2))
    assert difference < 0.3 * ours.radiance.mean()
    assert theirs.mean() == pytest.approx(ours.radiance.mean(), rel=0.02)


def test_calls_of_the_naive_loop_draw_other_samples():
    """A large frame is rendered in several calls, whose mean is that of all their samples."""
    naive = NaiveLoop(renderer(plate(None, light=SunSky())))
    one = naive.frame(2, 4)
    other = naive.frame(2, 4, 1)
    np.testing.assert_array_equal(one, naive.frame(2, 4))
    assert (one != other).mean() > 0.5


def test_the_variance_of_the_reference_is_subtracted():
    rng = np.random.default_rng(1)
    truth = np.ones((300, 300))
    target = Target(truth + 0.02 * rng.standard_normal((2, 300, 300)))
    image = truth + 0.01 * rng.standard_normal((300, 300))
    # Without the correction the distance would be sqrt(0.01^2 + 0.02^2 / 2) and 4.8 dB worse.
    assert target.psnr(image) == pytest.approx(20 * math.log10(target.white / 0.01), abs=0.3)


def test_the_verdict_needs_the_median_and_no_scene_slower():
    good = RenderReport(8, 10, "llvm", (ROW, replace(ROW, scene="b/0")), {"a/0": 1.0})
    assert good.median_ratio == pytest.approx(12.0)
    assert good.ok
    assert not replace(good, rows=(*good.rows, replace(ROW, level=30.0, seconds=4.0))).ok
    assert not replace(good, rows=(replace(ROW, seconds=0.5),)).ok
    sharing = replace(good, rows=(*good.rows, replace(ROW, seconds=0.1, neighbours=2)))
    assert sharing.median_ratio == pytest.approx(12.0)
    assert "32 denoised, 2 neighbours" in rendering.table(sharing)
    assert json.loads(json.dumps(good.to_dict()))["rows"][0]["ratio"] == pytest.approx(12.0)
    assert good.to_dict()["rows"][0]["obvious_samples"] == 1024
    text = rendering.table(good)
    assert "12.0 times faster" in text
    assert "32 denoised" in text


def test_levels_without_the_one_that_counts_are_refused():
    with pytest.raises(ValueError, match="40 among its levels"):
        rendering.run([plate(None)], levels=(30.0,))


@pytest.mark.parametrize("neighbours", [0, 3])
def test_frames_that_share_samples_have_a_row_where_they_are_predicted_to_cost_less(monkeypatch, neighbours):
    def choose(scene, *, psnr, reuse):
        return Budget(int(psnr), neighbours=neighbours * reuse)

    def compare(scene, name, level, chosen, *rest):
        return replace(ROW, level=level, samples=chosen.samples, neighbours=chosen.neighbours)

    monkeypatch.setattr(rendering.fidelity, "choose_budget", choose)
    monkeypatch.setattr(rendering, "_compare", compare)
    report = rendering.run([plate(None, light=SunSky())], levels=(30.0, 40.0), reference_samples=4)
    expected = [(30.0, 0), (40.0, 0)] + [(40.0, neighbours)] * (neighbours > 0)
    assert [(row.level, row.neighbours) for row in report.rows] == expected


class Timed:
    """A renderer whose frames reach 38 dB below 12 samples and 41 dB from them on; frames after FRAME state 10 dB."""

    def __init__(self, scene, *, budget):
        self.budget = budget

    def frame(self, t, with_truth):
        stated = 10.0 if t > FRAME else 39.0
        return SimpleNamespace(
            radiance=38.0 if self.budget.samples < 12 else 41.0, errors_at=[(1.0, 10 ** (-stated / 20))]
        )


@pytest.mark.parametrize(("chosen", "raised"), [(8, True), (16, False)])
def test_a_row_states_the_error_of_the_scored_frame_and_the_chosen_samples(monkeypatch, chosen, raised):
    monkeypatch.setattr(rendering, "Renderer", Timed)
    monkeypatch.setattr(rendering, "NaiveLoop", lambda ours: SimpleNamespace(mean=lambda t, samples: 40.0))
    target = SimpleNamespace(white=1.0, psnr=lambda image: image)
    row = rendering._compare(None, "a/0", 40.0, Budget(chosen, 4), target, rounds=1, most_samples=256)
    assert row.stated_psnr == pytest.approx(39.0)
    assert row.psnr == 41.0
    assert (row.chosen_samples, row.raised) == (chosen, raised)
    assert (row.samples > chosen) == raised
    text = rendering.table(RenderReport(8, 10, "llvm", (row,), {"a/0": 1.0}))
    assert ("12 (raised from 8)" in text) == raised


@pytest.mark.slow
def test_a_small_run_ends_with_rows_that_reach_their_levels(tmp_path):
    report = rendering.run(
        [plate(Spin((0, 0, 1), 200.0), light=SunSky())], levels=(30.0, 40.0), reference_samples=1152, rounds=1
    )
    assert [row.level for row in report.rows if not row.neighbours] == [30.0, 40.0]
    for row in report.rows:
        assert row.psnr >= row.level
        assert row.naive_psnr >= row.level
        assert row.stated_psnr == pytest.approx(row.psnr, abs=4)
    rendering.figure(report, tmp_path / "speed.png")
    assert (tmp_path / "speed.png").stat().st_size > 5000
