"""Tests the tables of a page: evaluations, studies, costs and validations from their files."""

import json
from pathlib import Path

import pytest

from qsim.report import html, report
from qsim.report.table_sections import evaluation_section, study_section, training_section
from qsim.studies.validation.backends import BackendReport, BackendRow
from qsim.studies.validation.light import LightReport, LightRow
from qsim.studies.validation.reading import ReadingReport
from qsim.studies.validation.sensors import SensorReport, SensorRow


def test_an_evaluation_defines_its_scores(folder):
    path = folder / "evaluation.json"
    found = json.loads(path.read_text()) | {"peak": "2.5 x the stream's mean light", "remarks": ["<mine> was never"]}
    line = found["table"][0] | {"above_peak": 0.0961, "truth_psnr": 21.0, "near_truth": ["psnr_matched"]}
    path.write_text(json.dumps(found | {"table": [line]}))
    page = report.build_page(folder, title="All")
    for words in (
        "behind the clamp",
        "9.6 %",
        "20.00 ± 1.00 †",
        "within 3 dB of the noise floor",
        "&lt;mine&gt; was never",
    ):
        assert words in page, words


def scored(method: str, light: str, psnr: float | str | None, scenes: int = 3) -> dict:
    """A line of a stored table; `psnr` is None without a score, and the text inf for an infinite one."""
    interval = {"mean": psnr, "half_width": 0.5 if isinstance(psnr, float) else None, "scenes": scenes}
    scores = dict.fromkeys(("psnr", "psnr_matched", "ssim_matched"), interval)
    return {"method": method, "light": light, "seconds_per_frame": 6.5e-5, "truth_psnr": 38.0, "scores": scores}


def evaluated(folder: Path, *lines: dict, **plan: object) -> html.Section:
    """The section of an evaluation with these lines and this plan."""
    found = {"format": "quiver-evaluation-2", "peak": "white", "plan": plan, "table": lines}
    (folder / "evaluation.json").write_text(json.dumps(found))
    return evaluation_section(folder / "evaluation.json")


def test_the_top_of_a_page_tells_the_best_method_and_the_kept_weights(tmp_path):
    """The best of each light level, and the best validation, not the last."""
    lines = [
        scored("a", "3 PPP", 20.0),
        scored("b", "3 PPP", 22.0),
        scored("a", "9 PPP", 25.0),
        scored("b", "9 PPP", 24.0),
    ]
    evaluation = {"format": "quiver-evaluation-2", "peak": "white", "table": lines}
    (tmp_path / "evaluation.json").write_text(json.dumps(evaluation))
    entries = [
        {"step": i, "elapsed": 60.0 * i, "psnr_matched": psnr} for i, psnr in ((1, 20.0), (2, 22.76), (3, 22.26))
    ]
    (tmp_path / "history.json").write_text(json.dumps({"history": entries}))
    page = report.build_page(tmp_path)
    top = page.split("</header>")[0]
    assert "best matched PSNR is 22.0 ± 0.5 dB by b at 3 PPP, 25.0 ± 0.5 dB by a at 9 PPP." in top
    assert "reached 22.76 dB on the validation clips after 2.0 minutes" in top
    assert "<strong>22.76 dB</strong>" in top
    assert "are kept (22.76 dB); the last one has 22.26 dB" in page
    assert "It then got worse: the last validation is 0.50 dB below the best" in top
    assert '<td class="number">65 µs</td>' in page
    assert page.count("class=best") == 2
    assert "RVRT" not in page


def test_a_light_at_which_all_methods_failed_has_no_best_one(tmp_path):
    dark = [scored("naive", "3 PPP", None, scenes=0), scored("moment", "3 PPP", None, scenes=0)]
    section = evaluated(tmp_path, *dark)
    assert (section.story, section.facts) == ("", ())
    assert "class=best" not in section.body
    section = evaluated(tmp_path, *dark, scored("naive", "9 PPP", None, scenes=0), scored("moment", "9 PPP", -2.0))
    assert section.story == "The best matched PSNR is -2.0 ± 0.5 dB by moment at 9 PPP."


@pytest.mark.parametrize(
    ("plan", "words"),
    [
        ({"split": "test"}, "On held-out clips the best"),
        ({"split": "val"}, "On held-out clips the best"),
        ({"split": "train"}, "On training clips the best"),
        ({"split": None}, "The best"),
        ({"split": None, "published": True, "test_set": "x4k1000fps"}, "On held-out clips the best"),
    ],
)
def test_only_clips_that_do_not_train_are_called_held_out(tmp_path, plan, words):
    assert evaluated(tmp_path, scored("a", "3 PPP", 20.0), **plan).story.startswith(words)


@pytest.mark.parametrize(("published", "unit"), [(False, "clip"), (True, "window")])
def test_a_page_says_what_has_its_own_factor(tmp_path, published, unit):
    body = evaluated(tmp_path, scored("a", "3 PPP", 20.0), split="test", published=published).body
    assert f"matched = after the one factor per {unit} that is best" in body


def test_an_infinite_score_is_the_best(tmp_path):
    section = evaluated(tmp_path, scored("finite", "3 PPP", 40.0), scored("exact", "3 PPP", "inf"), split="test")
    assert section.story == "On held-out clips the best matched PSNR is inf dB by exact at 3 PPP."
    assert section.body.count("class=best") == 1
    assert "n/a" not in section.body


@pytest.mark.parametrize(("last", "told"), [(22.0, False), (21.996, False), (21.99, True)])
def test_a_page_says_that_a_curve_got_worse(tmp_path, last, told):
    entries = [{"step": i, "elapsed": 60.0 * i, "psnr_matched": psnr} for i, psnr in enumerate((20.0, 22.0, last))]
    path = tmp_path / "history.json"
    path.write_text(json.dumps({"history": entries}))
    assert ("got worse" in training_section(path).story) == told


@pytest.mark.parametrize("scores", [(20.0, 22.0, None), (20.0, None, 22.0), (None,)])
def test_validations_without_a_finite_score_are_left_out_of_the_curve(tmp_path, scores):
    """history.json holds null for them; the page says so where the last or every one is such."""
    entries = [{"step": i, "elapsed": 60.0 * i, "psnr_matched": psnr} for i, psnr in enumerate(scores)]
    path = tmp_path / "history.json"
    path.write_text(json.dumps({"history": entries}))
    section = training_section(path)
    assert ("reached 22.00 dB" in section.story) == (22.0 in scores)
    assert ("last validation has no finite score" in section.story) == (scores == (20.0, 22.0, None))
    assert ("no validation has a finite score" in section.body) == (scores == (None,))


def test_headings_have_units(tmp_path):
    row = {"model": "planes", "bits": 3, "blur_error": 0.5, "loss_of_prediction_db": 0.25, "new_key": 1}
    (tmp_path / "tradeoff.json").write_text(
        json.dumps({"answer": "3 bits are best.", "rows": [row], "structure_function": []})
    )
    page = report.build_page(tmp_path)
    for heading in ("blur [photons rms]", "loss of prediction [dB]", "new key"):
        assert f">{heading}</th>" in page, heading
    assert "3 bits are best." in page.split("</header>")[0]


def test_the_blur_of_a_figure_is_a_share_of_its_peak(tmp_path):
    figure = {"figure": 1, "rows": [{"clip": "fan", "panels": [{"label": "CMOS 60 fps", "blur_over_peak": 0.03}]}]}
    (tmp_path / "figure1.json").write_text(json.dumps(figure))
    assert ">blur [of the peak]</th>" in study_section(tmp_path / "figure1.json").body


def test_studies_costs_and_validations_have_their_sections(tmp_path):
    rows = [{"model": "planes", "bits": 3, "psnr_db": 21.25}, {"model": "multibit", "bits": 3, "psnr_db": None}]
    study = {"clip": "fan", "ppp": 0.65, "rows": rows, "structure_function": [0.0, 1.0]}
    sweep = {"cells": [{"speed": 2.0, "best_bits": 3}], "studies": [study]}
    figure = {"figure": 1, "rows": [{"clip": "fan", "panels": [{"label": "CMOS 60 fps", "psnr_db": 18.9}]}]}
    cost = {"method": "mergenet", "seconds_per_frame": 0.25, "psnr_matched": None, "failure": None}
    checked = {"model": "QIS", "engine": "fast", "megapixels_per_second": 99.5, "times_numpy": 25.0, "cdf_error": 1e-7}
    checked |= dict.fromkeys(("p_value", "z_mean", "z_variance", "mismatches_per_million"))
    sensor = {"ok": False, "pixels": 9, "rows": [checked], "cases": [{"name": "ties", "found": "right", "ok": False}]}
    frame = {"scene": "drums", "level": 40.0, "psnr": 40.5, "stated_psnr": 40.25, "samples": 16, "bounces": 4}
    frame |= {"seconds": 0.5, "obvious_seconds": 6.0, "obvious_psnr": 40.0, "ratio": 12.0}
    render = {"ok": True, "median_ratio": 12.0, "height": 8, "width": 10, "engine": "llvm", "rows": [frame]}
    reading = ReadingReport(clip=250.5, mp4=20.0, clip_processor=300.0, mp4_processor=9.0, difference=0.01).to_dict()
    files = {"s/tradeoff": study, "w/tradeoff": sweep, "f/figure1": figure, "sensor": sensor, "render": render}
    files["reading"] = reading
    for name, content in (files | {"b/bench": {"setting": {"height": 64}, "costs": [cost]}}).items():
        path = tmp_path / f"{name}.json"
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps(content))
    page = report.build_page(tmp_path)
    for words in ("Study: s", "Study: w", "Study: f", "Cost of a frame: b", "21.25", "CMOS 60 fps", "best bits"):
        assert words in page, words
    assert "sensors, 9 pixels a draw: something is OUTSIDE its bounds" in page
    assert "rendering, frames of 8 × 10, llvm: everything is within its bounds" in page
    assert "windows of 11 × 128 × 128 in a clip of 65 × 512 × 1024: as fast as wanted (100/s, 5 times)" in page
    assert "250.5" in page
    assert "<td>ties</td><td>right</td><td>wrong</td>" in page


def test_validations_without_a_section_are_left_out(tmp_path):
    """The JSON of `validate light` and `validate engines` beside that of the sensors; alone, they are nothing known."""
    light = LightReport(8, 10, "llvm", (LightRow("fan", 36.0, 37.0, 37.1, 36.5, 36.6, 16, 4, False, 0.0, 0.0, 0.001),))
    engines = BackendReport(8, 10, 32, (BackendRow("scalar", "fan", 0.5, None, 1.0, 0.01),), {"cuda": "no driver"})
    row = SensorRow("QIS", "fast", 99.5, times_numpy=25.0, cdf_error=1e-7)
    sensors = SensorReport([row], [], 9)
    for name, content in (("light", light), ("engines", engines), ("sensors", sensors)):
        (tmp_path / f"{name}.json").write_text(json.dumps(content.to_dict()))
    assert report.build_page(tmp_path).count("<h2>Validation") == 1
    for name in ("light", "engines"):
        with pytest.raises(ValueError, match="nothing to report"):
            report.build_page(tmp_path / f"{name}.json")


def test_a_study_shows_its_own_picture(tmp_path):
    """A study beside the picture of an earlier sweep, and a sweep beside that of an earlier study."""
    study = {"clip": "fan", "ppp": 0.65, "rows": [{"model": "planes", "bits": 3}], "structure_function": [0.0]}
    sweep = {"cells": [{"speed": 2.0, "best_bits": 3}], "studies": [study]}
    for name in ("tradeoff.png", "best.png"):
        (tmp_path / name).write_bytes(b"\x89PNG")
    for found, own in ((study, "tradeoff.png"), (sweep, "best.png")):
        (tmp_path / "tradeoff.json").write_text(json.dumps(found))
        body = study_section(tmp_path / "tradeoff.json").body
        assert body.count("data:image/png") == 1
        assert f"{tmp_path.name}/{own}" in body


def test_a_method_that_failed_on_some_clips_has_no_rank(tmp_path):
    """The mean over the clips that it could restore was the best, without a word."""
    lines = [scored("a", "3 PPP", 20.0), scored("b", "3 PPP", 24.0) | {"failures": ["large: a tile needs 132 x 132"]}]
    section = evaluated(tmp_path, *lines)
    assert "20.0 ± 0.5 dB by a at 3 PPP" in section.story
    assert "b at 3 PPP failed and has no rank: large: a tile needs 132 x 132" in section.body
    lines = [scored("a", "3 PPP", None, scenes=0), scored("b", "3 PPP", None, scenes=0) | {"failures": ["c: why"]}]
    body = evaluated(tmp_path, *lines).body
    assert (body.count("n/a"), body.count("failed</td>")) == (3, 3)


@pytest.mark.parametrize(
    ("entry", "words"),
    [({"step": 1, "psnr_matched": 20.0}, "key 'history[0].elapsed' is missing"), ({"step": "one"}, "history[0].step")],
)
def test_results_that_were_changed_are_refused_by_their_key(tmp_path, entry, words):
    path = tmp_path / "history.json"
    path.write_text(json.dumps({"history": [entry]}))
    with pytest.raises(ValueError, match="make it again") as refused:
        training_section(path)
    assert words in str(refused.value)
