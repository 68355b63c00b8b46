"""Tests that every page of results has a rule in benchmarks/Makefile, and that the rules name programs that exist."""

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MAKEFILE = ROOT / "benchmarks" / "Makefile"


def test_every_page_of_results_has_a_rule():
    listed = subprocess.run(["make", "-s", "-C", MAKEFILE.parent], check=True, capture_output=True, text=True)
    pages = {page.stem for page in (ROOT / "docs" / "results").glob("*.md")}
    assert set(listed.stdout.split()) == pages | {"million"}


@pytest.mark.parametrize("page", ["reuse", "equal_budget", "restorer_tuned", "i2"])
def test_a_rule_names_the_program_that_the_page_names(page: str):
    """Nothing runs: make prints what it would do."""
    words = ["make", "-n", "-C", str(MAKEFILE.parent), page, "PHOTOGRAPHS=photographs"]
    told = subprocess.run(words, check=True, capture_output=True, text=True).stdout
    named = re.search(r"`python benchmarks/(\w+\.py)", (ROOT / "docs" / "results" / f"{page}.md").read_text())
    assert named is not None
    assert f"benchmarks/{named[1]}" in told


def test_what_cannot_be_made_is_asked_for():
    done = subprocess.run(["make", "-n", "-C", MAKEFILE.parent, "cycles"], check=False, capture_output=True, text=True)
    assert done.returncode == 2
    assert "give BPY=" in done.stderr


def test_the_programs_of_all_rules_exist():
    programs = set(re.findall(r"\$\(RUN\)/(\w+\.py)", MAKEFILE.read_text()))
    assert programs
    assert not [name for name in programs if not (MAKEFILE.parent / name).is_file()]
