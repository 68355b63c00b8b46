"""The program that tunes the restorer on single cells: rows are made once, mistakes are one line."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from clips import write_dataset

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))

import restorer_tuned  # noqa: E402  (docs are not a package)


def row(name: str, shipped: list[float], tuned: list[float]) -> dict[str, object]:
    size = vars(restorer_tuned.TINY)
    return {"name": name, "size": size, "clips": ["a", "b"], "psnr": {"shipped": shipped, "tuned": tuned}}


def test_the_table_states_means_and_single_clips(tmp_path):
    out = tmp_path / "rows"
    out.mkdir()
    (out / "qis-3-3.25.json").write_text(json.dumps(row("qis-3-3.25", [20.0, 30.0], [20.5, 30.1])))
    restorer_tuned.write_table(out)
    assert "| qis-3-3.25 | 25.00 | 25.30 | +0.30 | +0.10 to +0.50 |" in out.with_suffix(".md").read_text()


@pytest.mark.slow
def test_a_cell_is_trained_scored_and_made_once(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    data = str(write_dataset(tmp_path / "data", {"train": 2, "val": 1, "test": 1}, frames=11))
    words = [data] * 4 + ["--tiny", "--cells", "qis-3-3.25", "--out", "rows", "--workers", "0"]
    assert restorer_tuned.main(words) == 0, capfd.readouterr().err
    path = tmp_path / "rows" / "qis-3-3.25.json"
    scores = json.loads(path.read_text())["psnr"]
    assert scores["shipped"] != scores["tuned"]
    written = path.stat().st_mtime_ns
    assert restorer_tuned.main(words) == 0
    assert path.stat().st_mtime_ns == written
    monkeypatch.setattr(restorer_tuned, "TINY", restorer_tuned.Size(steps=3, crop=32, batch=2, frames=1))
    assert restorer_tuned.main(words) == 2
    assert "was made with another size; remove it" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--cells", "qis-9-1"], "no cell is called 'qis-9-1'; known are qis-1-0.5"),
        ([], "no finished clip in split 'test'"),
    ],
)
def test_mistakes_are_one_sentence(tmp_path, capsys, words, told):
    data = str(write_dataset(tmp_path / "data", {"train": 1}, frames=11))
    assert restorer_tuned.main([*[data] * 4, *words, "--out", str(tmp_path / "rows")]) == 2
    printed = capsys.readouterr()
    assert told in printed.err
    assert printed.err.count("\n") == 1
    assert not (tmp_path / "rows").exists()
