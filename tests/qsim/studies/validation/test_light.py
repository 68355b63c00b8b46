"""Tests `qsim validate light`: the verdict on error and mean light, and small scenes that fulfil it."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from small_scenes import plate

from qsim import scenes
from qsim.scene import SunSky
from qsim.studies.validation import light
from qsim.studies.validation.light import LightReport, LightRow

ROW = LightRow("a/0", 36.0, 36.4, 36.3, 30.0, 30.1, 32, 4, True, -0.0040, 0.0043, 0.0002)


def test_the_verdict_needs_the_wanted_error_and_the_announced_light():
    good = LightReport(8, 10, "llvm", (ROW,))
    assert good.ok
    assert "as announced" in light.table(good)
    for wrong in (replace(ROW, reached=35.4), replace(ROW, light=-0.0106), replace(ROW, light=0.0043)):
        bad = replace(good, rows=(ROW, wrong))
        assert not bad.ok
        assert "NOT as wanted or announced: a/0" in light.table(bad)
        assert json.loads(json.dumps(bad.to_dict()))["ok"] is False
    with pytest.raises(ValueError, match="at least one scene"):
        light.run([])


def test_a_small_scene_has_the_stated_error_and_the_announced_light():
    """A plate in sun and sky, six frames of 24 x 33; the errors of so few pixels are accurate to about 5 %."""
    report = light.run([plate(None, light=SunSky())], levels=(32.0,), reference_samples=512, frames=tuple(range(6)))
    (row,) = report.rows
    assert row.ok
    assert row.stated == pytest.approx(row.reached, abs=1.5)
    assert row.reached_unclamped <= row.reached


@pytest.mark.slow
@pytest.mark.parametrize("family", ["glossy", "glass", "room", "shadow"])
def test_families_not_used_for_tuning_have_the_announced_light(family):
    report = light.run([scenes.load(family, seed=4).resized(64, 96)])
    assert report.ok, light.table(report)
