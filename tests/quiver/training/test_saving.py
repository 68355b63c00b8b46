"""Tests that pages and help state when a run is saved, from one declaration."""

from pathlib import Path

from quiver.cli.program import PROGRAM
from quiver.training.saving import CHECKPOINT_SECONDS, WHEN, first_line

ROOT = Path(__file__).parents[3]


def test_help_and_page_state_the_interval():
    assert f"saved every {CHECKPOINT_SECONDS:g} s" in " ".join(PROGRAM.help("train").split())
    assert f"{CHECKPOINT_SECONDS:g} s" in WHEN
    page = " ".join((ROOT / "docs" / "training.md").read_text(encoding="utf-8").split())
    assert f"at the first validation, then every {CHECKPOINT_SECONDS:g} s, at the end, and on Ctrl-C" in page


def test_a_run_without_steps_states_none():
    assert first_line(0, steps=None, begun=False, finished=False).startswith("starts at step 0; ")
