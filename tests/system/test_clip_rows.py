"""The program of rows about the cost of frames: parts of time, both units, naive loop, page."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))
import clip_page  # noqa: E402
import clip_parts  # noqa: E402
import clip_rows  # noqa: E402


@pytest.fixture
def all_cores(monkeypatch):
    """The program keeps its process on two cores, which other tests here share."""
    monkeypatch.setattr(clip_rows, "use_only", lambda threads: None)


# Parts


def test_an_inner_part_interrupts_the_outer_one(monkeypatch):
    """The clock reads 0, 1, 3, 6, 10: rest for 1 s, frame for 2 s, paths for 3 s, and frame again for 4 s."""
    clock = iter([0.0, 1.0, 3.0, 6.0, 10.0])
    monkeypatch.setattr(clip_parts.time, "process_time", lambda: next(clock))
    parts = clip_parts.Parts()
    paths = parts.timed("paths", lambda x: 2 * x)
    assert parts.timed("frame", lambda x: paths(x) + 1)(3) == 7
    assert parts.seconds == {"rest": 1.0, "frame": 6.0, "paths": 3.0}


def test_functions_are_timed_inside_the_block_only():
    before = clip_page.kind_of
    row = {"plan": {"height": 2, "width": 3, "motion": 1.5}}
    with clip_parts.timed_parts({"clip_page:kind_of": "naming"}) as parts:
        assert clip_page.kind_of(row) == "2 × 3, 1.5 px/frame"
    assert "naming" in parts.seconds
    assert clip_page.kind_of is before


@pytest.mark.parametrize("target", clip_rows.TARGETS)
def test_parts_are_functions_of_this_program(target):
    with clip_parts.timed_parts({target: "part"}):
        pass


def test_ground_truth_and_writing_are_no_part_of_the_radiance():
    taken = [{"paths": s, "truth": 5.0, "writing": 7.0} for s in (3.0, 1.0, 2.0)]
    found = clip_parts.middle(taken, ["paths", "truth", "writing", "denoiser"])
    assert found["processor_seconds"] == 2
    assert found["parts"] == {"paths": 2, "truth": 5, "writing": 7, "denoiser": 0}


# Errors


def test_errors_in_both_units():
    """1 % of the pixels are 100, the others 1: white is 2.5 x 1.99, the 99.9th percentile 100.

    An error of 1 in the bright pixels is above white, and counts below the percentile only.
    """
    truth = np.ones((1, 100, 100))
    truth[0, 0] = 100
    picture = truth + np.where(truth > 1, 1.0, 0.01)
    found = clip_rows.reached(picture, np.stack([truth, truth]))
    dim = 0.99 * 0.01**2
    bright = 0.01 * 1.0**2
    assert found["white"] == pytest.approx(20 * np.log10(2.5 * 1.99 / np.sqrt(dim)), abs=0.006)
    assert found["peak"] == pytest.approx(20 * np.log10(100 / np.sqrt(dim + bright)), abs=0.006)


def test_the_naive_loop_takes_the_power_of_two_that_reaches_the_level():
    """64 samples reach 34 and 43.1 dB: 40 dB take 64 x 10^0.6 = 255, and 64 x 10^-0.31 = 31."""
    found = {"white": 34.0, "peak": 43.1}
    to_white, to_peak = (clip_rows.extrapolated(found, unit, 40.0, 0.5) for unit in found)
    assert (to_white["samples"], to_white["processor_seconds"]) == (256, 2.0)
    assert to_white["reached"] == {"white": 40.02, "peak": 49.12}
    assert (to_peak["samples"], to_peak["processor_seconds"]) == (32, 0.25)


def test_scenes_move_as_far_as_wanted():
    scene, motion = clip_rows.moving_scene("plain", clip_rows.TINY)
    assert 1 <= motion <= 3
    assert motion == clip_rows.median_motion(scene, clip_rows.TINY)


# Rows and page


def test_a_row_without_shared_frames_counts_with_frames_alone():
    def ways(**seconds: float) -> dict:
        return {name.replace("_", ", "): {"processor_seconds": s} for name, s in seconds.items()}

    plan = {"height": 2, "width": 3, "motion": 2.0}
    first = ways(naive_white=90.0, naive_peak=50.0, alone=8.0, shared=2.0)
    other = ways(naive_white=30.0, naive_peak=30.0, alone=4.0)
    lines = clip_page.medians({"a": {"plan": plan, "ways": first}, "b": {"plan": plan, "ways": other}})
    assert "| 2 × 3, 2 px/frame | 2 | frames that share | 3.000 | 20.00 | 2.00 |" in lines


@pytest.mark.slow
def test_rows_are_made_once_and_the_page_holds_what_they_hold(tmp_path, capsys, all_cores):
    line = ["--rows", "plain", "--tiny", "--out", str(tmp_path / "rows")]
    assert clip_rows.main(line) == 0
    assert "plain-24x32.json: written" in capsys.readouterr().out
    row = json.loads((tmp_path / "rows" / "plain-24x32.json").read_text())
    alone = row["ways"]["alone"]
    assert row["references"]["noise"] > alone["reached"]["white"]
    assert alone["processor_seconds"] > alone["parts"]["paths"] > 0
    assert clip_rows.main(line) == 0
    assert capsys.readouterr().out == ""
    assert f"| {row['ways']['alone']['processor_seconds']:.3f} |" in (tmp_path / "rows.md").read_text()
