"""Tables of an evaluation: complete, marked where the truth limits a score, and readable at any peak."""

from __future__ import annotations

import json
import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
from clips import ClipMaker
from methods import method

from quiver.data.codes import sensed
from quiver.data.illumination import Illumination
from quiver.evaluation import summary
from quiver.evaluation.comparison import (
    Comparison,
    ComparisonRow,
    evaluate,
)
from quiver.evaluation.metrics import Score
from quiver.restoration.interface import Restorer
from quiver.restoration.restorers import restorer


def test_the_table_holds_what_was_promised(tiny_dataset, tmp_path):
    comparison = Comparison(str(tiny_dataset), lights=(Illumination(), Illumination.of(ppp=26.0)))
    methods = [restorer("naive"), restorer("moment:3")]
    rows = evaluate(comparison, methods, tmp_path / "t")
    summary.write(tmp_path / "t", comparison, methods, rows)
    found = json.loads((tmp_path / "t/evaluation.json").read_text())
    assert len(found["rows"]) == 2 * 2 * 2
    line = found["table"][1]
    assert (line["method"], line["light"], line["scores"]["psnr"]["scenes"]) == ("moment:3", "3.25 PPP, 3 bit", 2)
    assert line["scores"]["psnr"]["half_width"] > 0
    assert line["truth_psnr"] == pytest.approx(rows[0].truth_psnr, abs=3)
    text = (tmp_path / "t/evaluation.md").read_text()
    assert "| moment:3 | 3 (1) | 26 PPP, 3 bit |" in text
    assert "| sliding:400 | 3.25 PPP, 3 bit |" in text
    assert "No weights" not in text  # what is not there is no part of a user's result
    assert "By motion" not in text  # these clips have no flow
    assert all(row.peak_bytes is not None and 0 <= row.peak_bytes < 2e9 for row in rows)
    for picture in ("evaluation.png", "crops_3.25PPP_3bit.png", "crops_26PPP_3bit.png"):
        assert (tmp_path / "t" / picture).read_bytes().startswith(b"\x89PNG")


def test_a_method_with_a_state_uses_all_earlier_frames(make_clip: ClipMaker):
    comparison = Comparison(str(make_clip(frames=4).path), None)
    streaming = replace(method("state", lambda codes: np.ones(codes.shape)), window=13, look_ahead=7, seamless=False)
    rows = evaluate(comparison, [streaming, restorer("moment:3")])
    text = summary.markdown(comparison, [streaming, restorer("moment:3")], rows)
    assert "| state | all earlier (7) | 3.25 PPP, 3 bit |" in text
    assert "| moment:3 | 3 (1) | 3.25 PPP, 3 bit |" in text
    found = summary.as_dict(comparison, [streaming, restorer("moment:3")], rows)["methods"]
    assert [(one["frames"], one["future"]) for one in found] == [(None, 7), (3, 1)]


def test_a_one_bit_sensor_in_much_light_is_not_perfect(make_clip: ClipMaker):
    """At 10 PPP every pixel lies above the white of a 1-bit code: with that as peak, every guess would be perfect."""
    comparison = Comparison(
        str(make_clip().path), None, (Illumination.of("spad-320x240", 1.0, 1), Illumination.of("spad-320x240", 10.0, 1))
    )
    dim, bright = evaluate(comparison, [restorer("moment")])
    assert bright.score.psnr < dim.score.psnr < 40
    hidden = evaluate(replace(comparison, peak=1.0), [restorer("moment")])[1]
    assert hidden.score.above_peak > 0.9
    assert not math.isinf(hidden.score.psnr)
    text = summary.markdown(replace(comparison, peak=1.0), [restorer("moment")], [dim, hidden])
    assert "peak = 1 photons per pixel" in text
    assert "Warning: 100.0 % of the pixels of sliding_0 at 10 PPP, 1 bit lie above the peak" in text
    assert " inf " not in text


@pytest.mark.parametrize("peak", [1e-6, 1e9])
def test_an_extreme_peak_has_a_table_and_no_foreign_warning(peak, tiny_dataset, tmp_path):
    comparison = Comparison(str(tiny_dataset), peak=peak)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        methods = [restorer("naive")]
        rows = evaluate(comparison, methods, tmp_path / "out")
        summary.write(tmp_path / "out", comparison, methods, rows)
    assert all(row.failure is None for row in rows)
    crops = list((tmp_path / "out/crops").glob("*.npy"))
    assert crops
    assert all(np.isfinite(np.load(crop)).all() for crop in crops)


def test_scores_near_the_truth_are_marked(make_clip: ClipMaker):
    """A truth with an error of 3 % of its mean has 38.4 dB; an answer of 36 dB is marked, one of 20 dB is not."""
    clip = make_clip("rough", error=0.03 * make_clip().mean_radiance)
    rng = np.random.default_rng(11)

    def wrong(psnr: float) -> Restorer:
        sigma = 2.5 * 3.25 * 10 ** (-psnr / 20)
        exact = sensed(clip, Illumination())[1].video()
        return method(f"at {psnr:g}", lambda codes: exact + rng.normal(0, sigma, exact.shape))

    comparison = Comparison(str(clip.path), None)
    methods = [wrong(36.0), wrong(20.0)]
    rows = evaluate(comparison, methods)
    assert rows[0].truth_psnr == pytest.approx(20 * math.log10(2.5 / 0.03), abs=0.01)
    near, far = summary.summarise(rows)
    assert near.near_truth == ("psnr", "psnr_matched")
    assert far.near_truth == ()
    text = summary.markdown(comparison, methods, rows)
    assert f"{near.scores['psnr'].mean:.2f} † |" in text
    assert f"{far.scores['psnr'].mean:.2f} |" in text
    assert "† In one clip or more within 3 dB of the noise floor of the ground truth" in text


@pytest.mark.parametrize(
    ("window", "future", "seamless", "stated", "published"),
    [
        (11, 5, True, (11, 5), (11, 5)),
        (3, 1, True, (3, 1), (3, 1)),
        (42, 0, True, (42, 0), (6, 0)),  # EMVD
        (51, 9, True, (51, 9), (11, 5)),  # FloRNN
        (13, 7, False, (None, 7), (11, 5)),  # QUIVER with its state
    ],
)
def test_frames_of_a_method_lie_in_the_published_window(window, future, seamless, stated, published):
    method = Restorer("x", window, future, True, "", lambda *given: None, seamless)
    assert summary.frames_of(method, published=False) == stated
    assert summary.frames_of(method, published=True) == published


def test_an_infinite_score_is_stored_as_one():
    score = Score(math.inf, math.inf, 1.0, 1.0, scale=1.0, scale_spread=0.0, frames=3)
    rows = [ComparisonRow("exact", "", "3.25 PPP, 3 bit", "fan", "fan", score)]
    found = summary.as_dict(Comparison("data"), [], rows)
    assert found["table"][0]["scores"]["psnr_matched"] == {"mean": "inf", "half_width": None, "scenes": 1}
    assert found["rows"][0]["score"]["psnr_matched"] == "inf"


def test_clips_of_several_devices_have_no_common_time():
    """Their mean was shown, beside the device and the threads of the last call."""
    light = "3.25 PPP, 3 bit"
    net = method("net", lambda codes: codes)
    first = ComparisonRow("net", "", light, "a", "a", Score(20.0, 21.0, 0.5, 0.6, 1.0, 0.0, frames=3), 1.0, 5_000_000)
    first = replace(first, device="cuda", threads=4)
    second = replace(first, clip="b", scene="b", seconds_per_frame=3.0)
    rows = [first, replace(second, device="cpu", threads=1)]
    line = summary.as_dict(Comparison("data"), [net], rows)["table"][0]
    assert (line["devices"], line["threads"]) == (["cuda", "cpu"], [4, 1])
    assert (line["seconds_per_frame"], line["peak_bytes"]) == (None, None)
    text = summary.markdown(Comparison("data"), [net], rows)
    assert "| - | - |" in text
    assert "not all clips were restored alike: net, 3.25 PPP, 3 bit (devices: cuda, cpu; threads: 4, 1)." in text
    text = summary.markdown(Comparison("data"), [net], [first, second])
    assert "| 2 | 5 MB |" in text
    assert "restored alike" not in text


def test_clips_without_a_scene_are_told():
    """Imported clips state none, so that each counts as a scene."""
    net = method("net", lambda codes: codes)
    score = Score(20.0, 21.0, 0.5, 0.6, 1.0, 0.0, frames=3)
    row = ComparisonRow("net", "", "3.25 PPP, 3 bit", "a", "a", score)
    alone = summary.markdown(Comparison("data"), [net], [row, replace(row, clip="b", scene="b")])
    assert "(clips of one scene averaged first; clips that state no scene count as one each)" in alone
    known = [replace(row, scene="fan:0"), replace(row, clip="b", scene="fan:1")]
    assert "state no scene" not in summary.markdown(Comparison("data"), [net], known)
