"""The program of the restorer's grid: what is measured stays, tables hold whole cells, mistakes are one line."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from clips import write_dataset

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))

import restorer_cells  # noqa: E402
import restorer_grid  # noqa: E402  (docs are not a package)


def cell(name: str, own: float, rivals: dict[str, float]) -> dict[str, object]:
    """A cell of one clip, whose six bins of motion hold 100 pixels each with these errors in dB."""

    def row(psnr: float) -> dict[str, object]:
        return {"psnr": psnr, "pixels": [100] * 6, "squares": [100 * 10 ** (-psnr / 10)] * 6}

    scores = {"clip": {"restorer": row(own)} | {method: row(psnr) for method, psnr in rivals.items()}}
    return {"name": name, "frames": 4, "weights": "0" * 64, "scores": scores}


def test_a_cell_is_compared_with_its_best_rival():
    own, best, rival, bins = restorer_grid.compared(cell("qis-3-1", 25.0, {"naive": 20.0, "qbp": 24.0, "qbp:5": 23.0}))
    assert (own, best, rival) == (25.0, "qbp", 24.0)
    np.testing.assert_allclose(bins, [1.0] * 6, atol=1e-9)


def test_every_bin_has_its_own_rival_and_empty_bins_none():
    told = cell("qis-3-1", 25.0, {"naive": 20.0, "qbp": 24.0})
    rows = told["scores"]["clip"]
    rows["naive"]["squares"][2] = 100 * 10 ** (-2.7)
    for row in rows.values():
        row["pixels"][5] = 0
        row["squares"][5] = 0.0
    bins = restorer_grid.compared(told)[3]
    np.testing.assert_allclose(bins[:5], [1.0, 1.0, -2.0, 1.0, 1.0], atol=1e-9)
    assert np.isnan(bins[5])


def test_a_method_that_fails_on_one_clip_is_no_rival():
    told = cell("qis-3-1", 25.0, {"naive": 20.0, "qbp": 24.0})
    other = json.loads(json.dumps(told["scores"]["clip"]))
    other["qbp"] = None
    told["scores"]["other"] = other
    assert restorer_grid.compared(told)[1] == "naive"


def test_tables_hold_the_cells_that_are_complete(tmp_path):
    out = tmp_path / "grid"
    out.mkdir()
    for name, own in (("qis-3-3.25", 25.0), ("qis-1-0.5", 23.5)):
        (out / f"{name}.json").write_text(json.dumps(cell(name, own, {"naive": 20.0, "qbp": 24.0})))
    growing = cell("qis-3-1", 30.0, {"naive": 20.0, "qbp": 24.0}) | {"scores": {}}
    (out / "qis-3-1.json").write_text(json.dumps(growing))
    restorer_grid.write_tables(out, [place.name for place in restorer_grid.places()], ["clip"])
    text = out.with_suffix(".md").read_text()
    assert "Mean over 2 cells: +0.25 dB. Least: -0.50 dB. Below the best classical method: qis-1-0.5." in text
    assert text.index("| qis-1-0.5 |") < text.index("| qis-3-3.25 |")
    assert out.with_suffix(".png").stat().st_size > 1000


def test_names_are_those_of_the_issue():
    names = [place.name for place in restorer_grid.places()]
    assert len(names) == len(set(names)) == 5 * 6 + 3 * 3
    assert {"qis-7-100", "spad-1-1", "spad-7-4.9", "spad-31-20"} <= set(names)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["none"], "no such data set"),
        (["data", "--cells", "qis-3-4"], "no cell is called 'qis-3-4'; known are qis-1-0.5"),
        (["data", "--restorer", "nothing"], "no method 'nothing'"),
        (["trained"], "no finished clip in split 'test'"),
    ],
)
def test_mistakes_are_one_sentence(tmp_path, monkeypatch, capsys, words, told):
    monkeypatch.chdir(tmp_path)
    write_dataset(tmp_path / "data", {"test": 1})
    write_dataset(tmp_path / "trained", {"train": 1})
    assert restorer_grid.main([*words, "--out", "grid"]) == 2
    printed = capsys.readouterr()
    assert told in printed.err
    assert printed.err.count("\n") == 1
    assert not list(tmp_path.glob("grid/*"))


def test_only_what_is_missing_is_measured(tmp_path, monkeypatch, capsys):
    """New clips and methods are added, other weights replace the restorer's rows, and nothing else changes."""
    write_dataset(tmp_path / "data", {"test": 2})
    calls: list[tuple[str, list[str]]] = []
    measured = restorer_grid.measured

    def counted(clip, names, light, args):
        calls.append((clip.name, list(names)))
        return measured(clip, names, light, args)

    monkeypatch.setattr(restorer_grid, "measured", counted)
    monkeypatch.setattr(restorer_grid, "CLASSICAL", ("naive",))
    words = [str(tmp_path / "data"), "--cells", "qis-3-3.25", "--frames", "2", "--out", str(tmp_path / "grid")]
    assert restorer_grid.main(words) == 0
    path = tmp_path / "grid" / "qis-3-3.25.json"
    first = json.loads(path.read_text())["scores"]
    assert [names for _, names in calls] == [["restorer", "naive"]] * 2
    other = json.loads(path.read_text()) | {"name": "qis-1-0.5"}
    (path.parent / "qis-1-0.5.json").write_text(json.dumps(other))
    assert restorer_grid.main(words) == 0
    assert "Mean over 2 cells" in (tmp_path / "grid.md").read_text()  # --cells chooses what is measured, not the page
    monkeypatch.setattr(restorer_grid, "CLASSICAL", ("naive", "moment:3"))
    assert restorer_grid.main(words) == 0
    assert [names for _, names in calls[2:]] == [["moment:3"]] * 2
    monkeypatch.setattr(restorer_cells, "digest", lambda path: "1" * 64)
    assert restorer_grid.main(words) == 0
    assert [names for _, names in calls[4:]] == [["restorer"]] * 2
    told = json.loads(path.read_text())
    assert told["weights"] == "1" * 64
    assert "Mean over 1 cells" in (tmp_path / "grid.md").read_text()  # the other cell has other weights
    assert all(told["scores"][name][method] == row for name, rows in first.items() for method, row in rows.items())
    assert restorer_grid.main(words) == 0
    assert len(calls) == 6
    capsys.readouterr()
    assert restorer_grid.main([*words[:3], "--frames", "3", *words[5:]]) == 2
    assert "was measured with another frames" in capsys.readouterr().err
    told["scores"]["elsewhere"] = {}
    path.write_text(json.dumps(told))
    assert restorer_grid.main(words) == 2
    assert "holds clips that" in capsys.readouterr().err


@pytest.mark.slow
def test_the_program_measures_a_cell_with_all_methods(tmp_path):
    write_dataset(tmp_path / "data", {"test": 1})
    words = [
        sys.executable,
        "benchmarks/restorer_grid.py",
        str(tmp_path / "data"),
        "--cells",
        "spad-7-4.9",
        "--frames",
        "1",
    ]
    done = subprocess.run([*words, "--out", str(tmp_path / "g")], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "| spad-7-4.9 |" in (tmp_path / "g.md").read_text()
