"""The program that compares ways to train a small QUIVER: equal time, stages, and rows that are made once."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from clips import write_dataset

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))
import recipe_rows  # noqa: E402


@pytest.mark.slow
def test_rows_of_stages(tmp_path, capsys, monkeypatch):
    """Speeds first; a way of two stages goes on from the first one, and its row is made once."""
    data = write_dataset(tmp_path / "data", {"train": 2, "val": 1, "test": 1})
    monkeypatch.setattr(recipe_rows, "recipe_digest", lambda data: "0" * 64)
    out = tmp_path / "rows"
    words = [str(data), "--tiny", "--out", str(out), "--work", str(tmp_path / "work"), "--rows", "bright-first"]
    assert recipe_rows.main([*words, "--seeds", "3"]) == 2
    assert "run this program with --speeds first" in capsys.readouterr().err
    assert recipe_rows.main([*words, "--speeds"]) == 0
    assert recipe_rows.main([*words, "--seeds", "3"]) == 0
    row = json.loads((out / "bright-first-3.json").read_text())
    first, second = (stage["settings"] for stage in row["stages"])
    assert (first["start"], first["ppp"], second["ppp"]) == (None, [26.0], None)
    assert second["start"] is not None
    assert row["scores"]["scores"]["psnr_matched"]["mean"] > 0
    assert "| bright-first |" in out.with_suffix(".md").read_text()
    assert "equal time of two cores" not in out.with_suffix(".md").read_text()
    assert recipe_rows.main([*words, "--seeds", "3", "--final", "long"]) == 0
    assert "| long |" in out.with_suffix(".md").read_text().partition("equal time of two cores")[2].replace("\\*", "")
    before = (out / "bright-first-3.json").stat().st_mtime_ns
    assert recipe_rows.main([*words, "--seeds", "3"]) == 0
    assert (out / "bright-first-3.json").stat().st_mtime_ns == before


def test_every_way_has_the_same_time(tmp_path):
    """Whatever a step costs, pre-denoiser and flow alone included, the steps of a row take the minutes of a row."""
    assert all(sum(share for share, _ in way.stages) == pytest.approx(1) for way in recipe_rows.WAYS.values())
    data = write_dataset(tmp_path / "data", {"train": 1})
    args = recipe_rows.parser().parse_args([str(data), "--out", str(tmp_path)])
    settings = {"pretraining": 0.25}
    asked = recipe_rows.settings_of(settings, args, out="unused", seed=0, steps=1)
    costs = {recipe_rows.cost_key(asked, False): 4.0, recipe_rows.cost_key(asked, True): 2.0}
    (tmp_path / "speeds.json").write_text(json.dumps({"seconds": costs}))
    assert recipe_rows.seconds_of(settings, args) == 3.5
    assert recipe_rows.seconds_of({}, args) == 4.0


def test_ways_that_came_later_are_measured_beside_known_ones():
    known = {"a": 2.0, "b": 8.0}
    assert recipe_rows.joined({}, known) == known
    assert recipe_rows.joined(known, {"a": 4.0, "c": 6.0}) == {"a": 2.0, "b": 8.0, "c": 3.0}
    with pytest.raises(ValueError, match="add a way that it knows"):
        recipe_rows.joined(known, {"c": 6.0})


def test_an_unknown_way_is_one_sentence(capsys):
    assert recipe_rows.main(["data", "--rows", "quick,quik"]) == 2
    assert capsys.readouterr().err.startswith("recipe_rows: no row is called 'quik'; known are quick, ")
