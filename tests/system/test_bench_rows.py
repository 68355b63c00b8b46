"""The program of the page of costs: rows are made once, and the page holds what they hold."""

from __future__ import annotations

import json
import re
import sys
from itertools import pairwise
from pathlib import Path

import pytest

from qsim.files import write_json
from quiver.evaluation.cost import checked_cases
from quiver.model.names import NETWORKS

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import bench_rows


@pytest.mark.slow
def test_rows_are_made_once_and_shown(tmp_path, capfd):
    out = tmp_path / "rows"
    words = ["--tiny", "--out", str(out), "--rows", "moment,emvd"]
    assert bench_rows.main(words) == 0
    capfd.readouterr()
    assert bench_rows.main(words) == 0
    assert capfd.readouterr().out == ""
    page = out.with_suffix(".md").read_text()
    row = json.loads((out / "emvd.json").read_text())["costs"][0]
    taken = row["seconds_per_frame"]
    memory = row["peak_bytes"] / 1e6
    macs = row["gmac_per_frame"]
    line = re.search(r"\| emvd(?:\\\*)? \| ([^|]+) \| ([^|]+) \| ([^|]+) \| ([^|]+) \|", page)
    assert line is not None
    assert line.groups() == (f"{taken:.3g}", f"{1 / taken:.3g}", f"{memory:.0f}", f"{float(f'{macs:.3g}'):g}")
    assert "Frames of 32 x 32 px" in page
    assert "not made yet: transform-denoise" in page
    assert bench_rows.main([*words[1:], "--busy"]) == 2  # of another size
    assert "was made with other options" in capfd.readouterr().err


def test_every_network_has_a_row_whose_options_are_known():
    assert {name for name in NETWORKS if name.endswith("-1m")} <= {*bench_rows.ROWS}
    for name in bench_rows.ROWS:
        plan = bench_rows.plan_of(name, tiny=False)
        modes, precisions = (text and text.split(",") for text in (plan.modes, plan.precisions))
        found = checked_cases(plan.methods.split(","), modes, precisions, None)
        assert len(found) == (6 if name == "modes" else 1)


def test_networks_are_measured_without_a_gpu(tmp_path, monkeypatch):
    """`quiver bench` refuses a device for classical methods."""
    asked = []

    def measured(*words: str, **options: object) -> None:
        asked.append(words)
        write_json(Path(words[words.index("-o") + 1]) / "bench.json", {"costs": []})

    monkeypatch.setattr(bench_rows, "quiver", measured)
    for name in ("qbp", "emvd", "modes"):
        bench_rows.make(tmp_path / f"{name}.json", bench_rows.plan_of(name, tiny=True), busy=True)
    assert [("--device", "cpu") in pairwise(words) for words in asked] == [False, True, True]


def test_rows_of_another_size_share_no_page(tmp_path, monkeypatch, capsys):
    """Whether they are asked for or not."""
    bench_rows.store(tmp_path / "moment.json", bench_rows.plan_of("moment", tiny=True), bench_rows.Watch.now(), {})
    monkeypatch.setattr(bench_rows, "make", lambda *words, **options: pytest.fail("made"))
    assert bench_rows.main(["--rows", "qbp", "--busy", "--out", str(tmp_path)]) == 2
    assert "moment.json: was made with other options" in capsys.readouterr().err


@pytest.mark.parametrize("cost", [None, "out of memory"])
def test_a_failed_method_states_why_and_counts_as_slowest(cost):
    row = {"seconds_per_frame": None if cost else 2.0, "gmac_per_frame": None, "psnr_matched": None, "peak_bytes": 0}
    found = bench_rows.cells(row | {"failure": cost})
    assert found == (["failed: out of memory", *[""] * 4] if cost else ["2", "0.5", "0", "", ""])
    assert bench_rows.seconds({"costs": [row]}) == (float("inf") if cost else 2.0)


def test_tiny_rows_stay_away_from_the_results(capsys):
    before = sorted(bench_rows.RESULTS.iterdir())
    assert bench_rows.main(["--tiny", "--rows", "moment"]) == 2
    assert capsys.readouterr().err.endswith("give --out\n")
    assert sorted(bench_rows.RESULTS.iterdir()) == before


def test_an_unknown_row_is_one_sentence(capsys):
    assert bench_rows.main(["--rows", "mergnet"]) == 2
    assert capsys.readouterr().err.startswith("bench_rows: no row is called 'mergnet'; known are moment,")
