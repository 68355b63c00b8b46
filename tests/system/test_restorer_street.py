"""The program of the street test: what is measured stays, the page shows every clip, mistakes are one line."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from clips import write_dataset

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))

import restorer_cells  # noqa: E402
import restorer_street  # noqa: E402  (benchmarks are not a package)


def row(psnr: float) -> dict[str, float]:
    return {"psnr": psnr, "ssim": 0.5, "scale": 1.0, "flicker": 0.01}


def cell(name: str, leads: dict[str, float]) -> dict[str, object]:
    """A cell of which QBP has 20 dB on every clip, the other methods less, and the restorer this much more."""
    scores = {
        clip: {"restorer": row(20.0 + lead), "auto": "mergenet"}
        | {method: row(20.0 if method == "qbp" else 18.0) for method in restorer_street.CLASSICAL}
        for clip, lead in leads.items()
    }
    return {"name": name, "frames": 4, "weights": "0" * 64, "scores": scores}


LEADS = {"street_0000_x2": 1.0, "street_0011_x2": -0.5, "street_0059_x6": 2.5}


def test_a_clip_is_named_by_its_subject_and_motion():
    assert (restorer_street.subject("street_0059_x6"), restorer_street.motion("street_0059_x6")) == (
        "corner",
        "handled drive",
    )
    assert restorer_street.motion("street_0011_x2") == "impact"


def test_the_page_leads_with_mean_interval_and_worst_clip(tmp_path):
    cells = [cell(place.name, LEADS) for place in restorer_street.PLACES]
    restorer_street.write_page(tmp_path / "street.md", cells)
    text = (tmp_path / "street.md").read_text()
    assert "| qis-3-3.25 | 21.00 | +1.00 ± 3.73 | -0.50 (granite, impact) | 1 | +1.00 (qbp) | 1 |" in text
    assert "| street_0059_x6 | corner | handled drive | +2.50 |" in text
    assert text.index("lead") < text.index("By subject")


def test_auto_counts_by_the_method_that_it_chooses(tmp_path):
    told = cell("qis-3-3.25", LEADS)
    told["scores"]["street_0011_x2"]["auto"] = "qbp"
    line = next(line for line in restorer_street.headline([told]) if line.startswith("| qis-3-3.25"))
    assert line.endswith("| 1 | +1.00 (qbp) | 0 |")


def test_flicker_is_the_change_of_the_error():
    rng = np.random.default_rng(0)
    truth = rng.random((4, 9, 9)) * 0.5 + 0.2
    assert restorer_street.flicker(truth + 0.1, truth) == pytest.approx(0.0, abs=1e-12)
    signs = np.array([1, -1, 1, -1])[:, None, None]
    assert restorer_street.flicker(truth + 0.05 * signs, truth) == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["none"], "no such data set"),
        (["data", "--restorer", "nothing"], "no method 'nothing'"),
        (["trained"], "no finished clip in split 'test'"),
    ],
)
def test_mistakes_are_one_sentence(tmp_path, monkeypatch, capsys, words, told):
    monkeypatch.chdir(tmp_path)
    write_dataset(tmp_path / "data", {"test": 1})
    write_dataset(tmp_path / "trained", {"train": 1})
    assert restorer_street.main([*words, "--out", "street"]) == 2
    printed = capsys.readouterr()
    assert told in printed.err
    assert printed.err.count("\n") == 1
    assert not list(tmp_path.glob("street/*"))


def test_only_what_is_missing_is_measured(tmp_path, monkeypatch, capsys):
    calls: list[list[str]] = []

    def counted(clip, names, light, weights):
        calls.append(list(names))
        return {name: row(21.0) for name in names} | {"auto": "mergenet"}

    monkeypatch.setattr(restorer_street, "measured", counted)
    monkeypatch.setattr(restorer_street, "subject", lambda clip: "granite")
    monkeypatch.setattr(restorer_street, "motion", lambda clip: "roll")
    write_dataset(tmp_path / "data", {"test": 2})
    words = [str(tmp_path / "data"), "--out", str(tmp_path / "street")]
    assert restorer_street.main(words) == 0
    assert len(calls) == 2 * len(restorer_street.PLACES)
    assert restorer_street.main(words) == 0
    assert len(calls) == 2 * len(restorer_street.PLACES)
    monkeypatch.setattr(restorer_cells, "digest", lambda path: "1" * 64)
    assert restorer_street.main(words) == 0
    assert calls[2 * len(restorer_street.PLACES) :] == [["restorer"]] * (2 * len(restorer_street.PLACES))
    path = tmp_path / "street" / "qis-3-3.25.json"
    told = json.loads(path.read_text())
    told["scores"]["elsewhere"] = {}
    path.write_text(json.dumps(told))
    capsys.readouterr()
    assert restorer_street.main(words) == 2
    assert "holds clips that the data set lacks" in capsys.readouterr().err
