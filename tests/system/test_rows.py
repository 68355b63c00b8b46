"""What the programs of stored rows share: trial rows stay apart, and rows of other options are not taken for ours."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))
import ablation_rows  # noqa: E402
import clip_rows  # noqa: E402
import cycles_rows  # noqa: E402
import equal_budget  # noqa: E402
import equal_steps  # noqa: E402
import restorer_ablation  # noqa: E402
import restorer_tuned  # noqa: E402
import reuse_rows  # noqa: E402
import rows  # noqa: E402

from quiver.cli.program import PROGRAM  # noqa: E402
from quiver.evaluation.cost import checked_cases  # noqa: E402


@pytest.mark.parametrize(
    ("program", "words"),
    [
        (equal_budget, ["data", "--tiny"]),
        (equal_budget, ["data", "--budget-seconds", "5"]),
        (equal_steps, ["data", "--tiny", "--steps", "2"]),
        (ablation_rows, ["data", "--tiny"]),
        (reuse_rows, ["--tiny"]),
        (clip_rows, ["--tiny"]),
        (cycles_rows, ["--tiny", "--cycles", "python"]),
        (restorer_ablation, ["data", "data", "data", "--tiny"]),
        (restorer_tuned, ["data", "data", "data", "data", "--tiny"]),
    ],
    ids=lambda value: getattr(value, "__name__", None) or " ".join(value),
)
def test_trial_rows_stay_away_from_the_page_and_from_the_runs_of_true_ones(capsys, monkeypatch, program, words):
    monkeypatch.setattr(program, "use_only", lambda threads: None, raising=False)
    before = sorted((ROOT / "docs" / "results").rglob("*"))
    assert program.main(words) == 2
    assert capsys.readouterr().err.endswith("trial rows do not belong on the page; give --out\n")
    assert sorted((ROOT / "docs" / "results").rglob("*")) == before
    assert rows.keep_apart("x", Path("rows"), trial=True) != rows.keep_apart("x", Path("rows"), trial=False)
    assert rows.keep_apart("x", Path("rows"), Path("w"), trial=True) == Path("w")


def test_a_stored_row_of_other_options_is_refused(tmp_path):
    plan = cycles_rows.Plan()
    assert not rows.is_made(tmp_path / "x.json", plan)
    rows.store(tmp_path / "x.json", plan, rows.Watch.now(), {})
    assert rows.is_made(tmp_path / "x.json", plan)
    with pytest.raises(ValueError, match="was made with other options; choose another --out"):
        rows.is_made(tmp_path / "x.json", cycles_rows.Plan(reference=1))


@pytest.mark.parametrize(
    ("folder", "plan"),
    [("reuse", reuse_rows.Plan()), ("cycles", cycles_rows.Plan()), ("clips", clip_rows.Plan())],
    ids=["reuse", "cycles", "clips"],
)
def test_rows_of_the_page_have_the_options_of_the_program(folder, plan):
    """Those whose size, motion and seed are the usual ones."""
    usual = json.loads(json.dumps(vars(plan)))
    stored = [rows.read_json(path)["plan"] for path in (ROOT / "docs" / "results" / folder).glob("*-128x256.json")]
    assert stored
    assert all(plan == usual for plan in stored)


@pytest.mark.parametrize("program", [ablation_rows, equal_steps], ids=str)
def test_a_page_of_equal_steps_holds_its_rows(program, tmp_path):
    page = ROOT / "docs" / "results" / program.__name__
    shutil.copytree(page, tmp_path / "rows")
    program.write_table(tmp_path / "rows")
    assert (tmp_path / "rows.md").read_text() == page.with_suffix(".md").read_text()


@pytest.mark.parametrize("method", ["fastdvdnet", "quiver-s", "mergenet-1m"])
def test_costs_are_asked_for_as_the_command_takes_them(tmp_path, monkeypatch, method):
    """Networks with one mode refuse --modes; of QUIVER the first cost is that of the mode exact."""

    def asked(*words: object, budget: rows.Budget) -> None:
        command, values = PROGRAM.read([str(word) for word in words])
        assert command is not None
        args = command.arguments(values)[0]
        first = checked_cases(args.methods, args.modes, args.precisions, args.device)[0]
        assert first.mode == "exact"
        rows.write_json(tmp_path / "bench.json", {"costs": [{"gmac_per_frame": 1.0, "method": first.method}]})

    monkeypatch.setattr(rows, "quiver", asked)
    assert rows.cost(method, tmp_path, rows.TINY)["method"] == method
