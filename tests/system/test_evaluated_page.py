"""The pages `starter` and `sums` take their measured parts from evaluations, and keep their words."""

import json
import re
import sys
from pathlib import Path

import pytest
from PIL import Image

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "benchmarks"))

import evaluated_page  # noqa: E402

PART = re.compile(r"(?<=-->\n).*?(?=<!-- end -->)", re.DOTALL)


@pytest.fixture
def evaluation(tmp_path: Path) -> Path:
    """A folder of `quiver evaluate` with two methods, the second of which failed."""
    folder = tmp_path / "evaluation"
    folder.mkdir()
    interval = {"mean": 21.414, "half_width": 2.375}
    good = {"method": "mergenet", "light": "4.9 PPP, 3 bit", "seconds_per_frame": 0.1404, "truth_psnr": 31.3}
    good |= {"scores": {"psnr_matched": interval, "ssim_matched": {"mean": 0.7666, "half_width": None}}}
    good |= {"psnr_by_motion": [22.764, 19.97, None, 18.3, None, None]}
    nothing = {"mean": None, "half_width": None}
    failed = good | {"method": "naive", "scores": dict.fromkeys(("psnr_matched", "ssim_matched"), nothing)}
    failed |= {"seconds_per_frame": None, "psnr_by_motion": [None] * 6}
    (folder / "evaluation.json").write_text(json.dumps({"table": [good, failed]}))
    (folder / "evaluation.md").write_text("# Evaluation of out/starter\n\nSensor quiver-physical.\n")
    for name in ("evaluation.png", "crops_3.25PPP_3bit.png"):
        Image.new("RGB", (4, 4), "red").save(folder / name)
    return folder


def outside(text: str) -> list[str]:
    """What stands outside of the measured parts."""
    return PART.split(text)


def test_sums_have_the_rows_of_their_programs(tmp_path, evaluation):
    before = (ROOT / "docs" / "results" / "sums.md").read_text(encoding="utf-8")
    page = tmp_path / "sums.md"
    page.write_text(before, encoding="utf-8")
    moved = {"scene": "fan", "planes": 7, "mean_px": 3.574, "median_error_px": 1.9e-4, "rms_error_px": 0.0113}
    (tmp_path / "flow.json").write_text(json.dumps([moved | {"p99_error_px": 0.0404, "lost": 0.0642}]))
    read = {"planes": 31, "windows_per_second": 17.8, "ms": 56.18, "ms_of_light": 19.71}
    (tmp_path / "windows.json").write_text(json.dumps([read]))
    files = ["--flow", str(tmp_path / "flow.json"), "--windows", str(tmp_path / "windows.json"), "--to", str(page)]
    assert evaluated_page.main(["sums", str(evaluation), *files]) == 0
    text = page.read_text(encoding="utf-8")
    for row in (
        "| `mergenet` | 21.41 ± 2.38 | 0.767 | 0.14 |",
        "| `naive` | n/a | n/a | - |",
        "| method | 0–0.5 | 0.5–1 | 2–4 |",
        "| `mergenet` | 22.76 | 19.97 | 18.30 |",
        "| fan | 7 | 3.57 | 1.9e-04 | 0.011 | 0.04 | 6.4 % |",
        "| 31 | 18 | 56.2 | 19.7 |",
    ):
        assert row in text
    assert outside(text) == outside(before)
    assert len(outside(before)) == 5


def test_starter_has_the_evaluation_and_its_pictures(tmp_path, evaluation, monkeypatch):
    monkeypatch.setattr(evaluated_page, "PAGES", tmp_path)
    (tmp_path / "starter.md").write_text("# Mine\n\n<!-- measured: evaluation -->\nold\n<!-- end -->\n\nMy words.\n")
    assert evaluated_page.main(["starter", str(evaluation)]) == 0
    text = (tmp_path / "starter.md").read_text()
    assert "old" not in text
    assert "Evaluation of out/starter" not in text
    assert "![Matched PSNR of all methods](starter.png)\n\nSensor quiver-physical." in text
    assert text.endswith("My words.\n")
    with Image.open(tmp_path / "starter.png") as bars, Image.open(tmp_path / "crops_3.25PPP.jpg") as sheet:
        assert (bars.size, sheet.format) == ((4, 4), "JPEG")


def test_a_page_without_measured_parts_is_refused(evaluation):
    with pytest.raises(ValueError, match="no measured part"):
        evaluated_page.filled("# Words alone\n", evaluated_page.Asked(evaluation, None, None))
