"""The program that trains a network in parts: each begins with the weights of the last one, and all are on one page."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
import torch
from clips import write_dataset
from safetensors.torch import load_file

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))
import long_run  # noqa: E402


@pytest.mark.slow
def test_two_parts_and_their_scores(tmp_path, monkeypatch):
    """Weights are kept as float16; the second part, on two processes, goes on from them; a classical method beside."""
    data = write_dataset(tmp_path / "data", {"train": 2, "val": 1, "test": 1})
    monkeypatch.setattr(long_run, "recipe_digest", lambda data: "0" * 64)
    monkeypatch.setattr(long_run, "BESIDE", ("moment",))
    monkeypatch.setattr(long_run, "LIGHTS", ("3.25",))
    out = tmp_path / "parts"
    words = [str(data), "--tiny", "--out", str(out), "--work", str(tmp_path / "work")]
    assert long_run.main([*words, "--steps", "2", "--processes", "1"]) == 0
    first = load_file(out / "quiver-s-1m.safetensors")
    assert {value.dtype for value in first.values()} == {torch.float16}
    assert long_run.main([*words, "--steps", "2", "--processes", "2", "--score"]) == 0
    second = load_file(out / "quiver-s-1m.safetensors")
    moved = max(float((second[name] - first[name]).abs().max()) for name in first)
    assert 0 < moved < 0.1
    parts = [json.loads((out / f"part-0{n}.json").read_text()) for n in (1, 2)]
    assert [part["settings"]["start"] is None for part in parts] == [True, False]
    page = out.with_suffix(".md").read_text()
    assert "| 2 | 2 | 0.003 |" in page  # two steps of two windows after two of one
    assert "| 6 |" in page
    assert "| data | moment |" in page
    assert out.with_suffix(".png").is_file()


def test_without_data_it_is_one_sentence(tmp_path, capsys):
    words = [str(tmp_path / "none"), "--tiny", "--out", str(tmp_path / "parts"), "--work", str(tmp_path / "work")]
    assert long_run.main([*words, "--steps", "2", "--processes", "1"]) == 2
    assert "a command failed with 2" in capsys.readouterr().err
