"""The program of mergenet's ablation: rows are made once, variants change what they say, mistakes are one line."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from clips import write_dataset

from quiver.model.mergenet import INPUTS

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))

import restorer_ablation as ablation  # noqa: E402  (docs are not a package)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ablation") / "data"
    return str(write_dataset(folder, {"train": 2, "test": 2}, frames=11))


@pytest.mark.slow
def test_rows_are_made_once_and_told_in_a_table(tmp_path, data, capsys):
    out = tmp_path / "rows"
    words = [data, data, data, "--tiny", "--out", str(out), "--work", str(tmp_path / "w"), "--workers", "0"]
    words += ["--rows", "all,no-motion,l1"]
    assert ablation.main(words) == 0, capsys.readouterr().err
    rows = {path.name: json.loads(path.read_text()) for path in out.glob("*.json")}
    assert len(rows) == 6
    assert len({round(row["psnr"], 6) for row in rows.values()}) == 6  # no variant and no seed does nothing
    assert all(np.isfinite(row["psnr"]) and row["curve"][-1]["step"] == 6 for row in rows.values())
    written = {path: path.stat().st_mtime_ns for path in out.glob("*.json")}
    assert ablation.main(words) == 0
    assert written == {path: path.stat().st_mtime_ns for path in out.glob("*.json")}
    text = out.with_suffix(".md").read_text()
    assert "| all ideas |" in text
    assert "| merged without motion |" in text


def test_every_variant_changes_what_is_learned():
    """All but those of other windows differ in the first step already."""
    rng = np.random.default_rng(0)
    shape = (2, 32, 32)
    batch = {
        "channels": rng.normal(size=(2, INPUTS, 32, 32)),
        "phi": 4 + rng.normal(size=shape),
        "top": np.full(2, 9.0),
    }
    batch |= {"deviation": np.full(shape, 0.3), "target": rng.uniform(0, 1, shape), "unit": np.ones(2)}
    batch["table"] = np.tile(np.linspace(0, 1, 16), (2, 1))
    tensors = {name: torch.from_numpy(value).float() for name, value in batch.items()}
    found = {}
    for name, variant in ablation.VARIANTS.items():
        torch.manual_seed(0)
        network = ablation.MergeNet(ablation.MergeNetConfig(width=variant.width))
        for parameter in network.parameters():  # its last layer starts at 0
            torch.nn.init.normal_(parameter, 0, 0.1)
        loss = float(ablation.error_of(network, tensors, variant).mean().detach())
        found[name] = (round(loss, 6), variant.windows, variant.kind)
    assert len(set(found.values())) == len(found)


def test_half_of_the_windows_are_photographs():
    size = ablation.Size(windows=10, batch=5)
    batches = ablation.order(size, 3)
    numbers = [n for _ in range(4) for n in next(batches)]
    assert sorted(numbers) == sorted([*range(10), *range(10)])
    halves = [{"ppp": np.zeros(10, np.float32)}, {"ppp": np.ones(10, np.float32)}]
    assert ablation.pick(halves, numbers[:10])["ppp"].mean() == 0.5


def test_all_arrays_of_a_batch_turn_alike():
    picture = torch.arange(16.0).view(1, 4, 4)
    seen = set()
    for step in range(64):
        told = ablation.turned({"phi": picture, "channels": picture[:, None] * 2, "top": torch.ones(1)}, (0, step))
        assert torch.equal(told["channels"][:, 0], told["phi"] * 2)
        seen.add(tuple(told["phi"].flatten().tolist()))
    assert len(seen) == 8


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["none", "none", "none"], "no such data set"),
        (["data", "data", "data", "--rows", "all,nothing"], "no row is called 'nothing'; known are all"),
        (["half", "half", "half"], "no finished clip in split 'test'"),
    ],
)
def test_mistakes_are_one_sentence(tmp_path, monkeypatch, capsys, words, told):
    monkeypatch.chdir(tmp_path)
    write_dataset(tmp_path / "data", {"train": 1, "test": 1}, frames=11)
    write_dataset(tmp_path / "half", {"train": 1}, frames=11)
    assert ablation.main([*words, "--tiny", "--out", "rows", "--workers", "0"]) == 2
    printed = capsys.readouterr()
    assert told in printed.err
    assert printed.err.count("\n") == 1
    assert not list(tmp_path.glob("rows/*"))


@pytest.mark.slow
def test_other_data_and_sizes_are_refused(tmp_path, monkeypatch, capsys, data):
    monkeypatch.chdir(tmp_path)
    words = ["--tiny", "--rows", "all", "--workers", "0"]
    assert ablation.main([data, data, data, *words, "--out", "rows"]) == 0
    other = str(write_dataset(tmp_path / "other", {"train": 1, "test": 1}, frames=11))
    assert ablation.main([data, other, data, *words, "--out", "more"]) == 2
    assert "holds windows of other data sets" in capsys.readouterr().err
    monkeypatch.setattr(ablation, "TINY", ablation.Size(windows=8, steps=7, batch=2, crop=32, test=1))
    assert ablation.main([data, data, data, *words, "--out", "rows"]) == 2
    assert "was made with another size" in capsys.readouterr().err
