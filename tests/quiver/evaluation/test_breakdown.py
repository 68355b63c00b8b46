"""Errors by motion and crops: sums agree, bins hold their pixels, crops lie where most moves."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from clips import ClipMaker
from methods import method
from numpy import ndarray as Array

from qsim.files import load_array
from qsim.streams.code_truth import CodeTruth
from qsim.streams.exposures import Timing
from quiver.cli.evaluate import OURS
from quiver.data.codes import Codes, sensed
from quiver.data.illumination import Illumination
from quiver.evaluation import breakdown, metrics, summary
from quiver.evaluation.comparison import Comparison, evaluate
from quiver.restoration.interface import Restorer
from quiver.restoration.restorers import restorer


def test_every_pixel_counts_in_one_bin():
    rng = np.random.default_rng(0)
    output, target = rng.uniform(-0.2, 1.3, (2, 3, 11, 7))
    speed = rng.uniform(0, 12, output.shape)
    pixels, squares = breakdown.by_motion(output, target, speed)
    assert sum(pixels) == output.size
    assert sum(squares) == pytest.approx(((np.clip(output, 0, 1) - np.clip(target, 0, 1)) ** 2).sum())
    assert breakdown.pooled([pixels], [squares])[3] == pytest.approx(
        metrics.decibel(squares[3] / ((speed >= 2) & (speed < 4)).sum())
    )
    speed[0] = np.nan
    assert sum(breakdown.by_motion(output, target, speed)[0]) == output.size * 2 // 3


def test_clips_are_pooled_by_their_pixels():
    found = breakdown.pooled([(9, 0, 0, 0, 0, 0), (1, 2, 0, 0, 0, 0)], [(0.0, 0, 0, 0, 0, 0), (1.0, 0.02, 0, 0, 0, 0)])
    assert found[:2] == pytest.approx([10.0, 20.0])
    assert all(math.isnan(psnr) for psnr in found[2:])
    assert len(found) == len(breakdown.bin_names())


def test_a_clip_with_flow_has_its_error_in_the_bin_of_its_motion(make_clip: ClipMaker, tmp_path):
    flow = np.zeros((2, 36, 44), np.float32)
    # 1.5 px/frame
    flow[0] = 1.2
    flow[1] = -0.9
    clip = make_clip(flow=flow)
    comparison = Comparison(str(clip.path), split=None)
    methods = [restorer("moment:3")]
    rows = evaluate(comparison, methods, tmp_path / "t")
    again = evaluate(comparison, methods, tmp_path / "t")
    assert again == rows  # motion survives the file
    line = summary.summarise(rows)[0]
    assert rows[0].motion_pixels == (0, 0, math.prod(clip.shape), 0, 0, 0)
    assert line.psnr_by_motion[2] == pytest.approx(line.scores["psnr_matched"].mean, abs=0.1)  # pooled or by frames
    text = summary.markdown(comparison, methods, rows)
    assert f"| moment:3 | 3.25 PPP, 3 bit | - | - | {line.psnr_by_motion[2]:.2f} | - | - | - |" in text


def test_windows_with_a_factor_each_are_matched_by_their_own(make_clip: ClipMaker, tmp_path):
    """An exact answer that flickers, in published windows: after the factor of each no error is left, nor in crops."""
    clip = make_clip(flow=np.full((2, 36, 44), 1.0, np.float32))
    comparison = Comparison(str(clip.path), None, (Illumination.of("quiver-published"),), published=True)
    exact = sensed(clip, comparison.lights[0])[1].video()

    def restore(codes: Codes) -> Array:
        t = int(codes.name.rpartition(" ")[2])
        return np.repeat(exact[t : t + 1] * (0.8 + 0.05 * t), codes.shape[0], axis=0)

    row = evaluate(comparison, [method("flicker", restore)], tmp_path / "t")[0]
    assert row.score.scale_spread > 0.03
    assert row.score.psnr_matched > 100
    assert sum(row.motion_pixels) == 4 * 36 * 44
    assert sum(row.motion_squares) / sum(row.motion_pixels) < 1e-10
    crop, whole = (
        np.load(breakdown.crop_file(tmp_path / "t", row.light, clip.name, name)) for name in (row.crop, "truth")
    )
    np.testing.assert_allclose(crop, whole, rtol=2e-3)


def test_the_sheet_shows_the_crops_of_its_rows(make_clip: ClipMaker, tmp_path, monkeypatch):
    """Other weights in the same folder have other crops, and a method that failed has none."""
    clip = make_clip(frames=3)
    out = tmp_path / "t"
    shown = []
    comparison = Comparison(str(clip.path), None)

    def noise(seed: int) -> Restorer:
        made = method("net", lambda codes: np.random.default_rng(seed).uniform(1, 9, codes.shape))
        return replace(made, description=f"weights {seed}")

    def load(path: Path) -> Array:
        shown.append(path.name)
        return load_array(path)

    first, second = (evaluate(comparison, [noise(seed)], out)[0] for seed in (1, 2))
    files = [breakdown.crop_file(out, row.light, clip.name, row.crop) for row in (first, second)]
    assert not np.array_equal(*map(np.load, files))
    monkeypatch.setattr(breakdown, "load_array", load)
    resumed = evaluate(comparison, [noise(1)], out)
    summary.write(out, comparison, [noise(1)], resumed)
    assert files[0].name in shown
    assert len(shown) == 3  # truth, codes, and the method
    shown.clear()
    summary.write(out, comparison, [noise(1)], [replace(first, failure="why", score=None)])
    assert len(shown) == 2
    assert all(re.fullmatch(OURS, str(path.relative_to(out))) for path in out.rglob("*") if path.is_file())


def test_crops_show_where_most_moves(make_clip: ClipMaker, tmp_path):
    flow = np.zeros((2, 120, 150), np.float32)
    flow[0, 90:110, 100:140] = 3.0
    clip = make_clip(frames=3, height=120, width=150, flow=flow)
    rows, columns = breakdown.place(CodeTruth(clip, Timing()), 1)
    assert (rows.stop - rows.start, columns.stop - columns.start) == (96, 96)
    assert rows.start <= 90
    assert rows.stop >= 110
    assert columns.start <= 100
    assert columns.stop >= 140
    still = make_clip("still", frames=3, height=120, width=40)
    assert breakdown.place(CodeTruth(still, Timing()), 1) == (slice(40, 80), slice(0, 40))
    assert not breakdown.sheet(tmp_path, "3.25 PPP", [clip.name], ["moment"], {}, tmp_path / "none.png")
    breakdown.save_crop(breakdown.crop_file(tmp_path, "3.25 PPP", clip.name, "truth"), np.zeros((8, 8)))
    lost = {(clip.name, "moment"): "moment 01234567"}
    assert not breakdown.sheet(tmp_path, "3.25 PPP", [clip.name], ["moment"], lost, tmp_path / "none.png")
    assert not (tmp_path / "none.png").exists()
