"""Words that this project does not use: one term for one thing, and no translated phrases (docs/glossary.md)."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

# Retired: the word to use. Invented terms first, then phrases that are not English.
RETIRED = {
    r"lanes?": "thread",
    r"ladders?": "cdf steps",
    r"doubtful": "uncertain",
    r"flaw(s|ed)?": "defect",
    r"footage": "recording",
    r"obvious(ly)?(?!_)": "naive loop",  # but for keys of stored reports
    r"hourglass(es)?(?!\")": "small U-Net",  # but for a name in stored weights
    r"crew": "workers",
    r"last[ _]words": "stderr tail",
    r"anew": "again",
    r"go(es)? on|went on": "resumes, continues",
    r"here and now": "(nothing)",
    r"by looks": "by appearance",
    r"at hand": "available",
    r"is said|said so": "is reported",
    r"of (its|their|one's) own": "its own",
    r"die[sd]?": "fails, stops, crashes",
    r"foresees?|foresaw|foreseen": "forecasts",
    r"whole or absent": "complete or absent",
}
KEPT = {"tests/system/test_words.py", "CHANGELOG.md"}  # this list; and the record of what older versions said


def texts() -> list[Path]:
    """Every Python file, page, recipe and template of the project."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    names = listed.stdout.split("\0") if not listed.returncode else [p.relative_to(ROOT) for p in ROOT.rglob("*.*")]
    kinds = {".py", ".md", ".toml", ".html"}
    return [ROOT / n for n in names if n and Path(n).suffix in kinds and str(n) not in KEPT and (ROOT / n).is_file()]


def found(word: str, text: str) -> list[str]:
    """The lines that hold a word, in any case, also inside of names_with_underscores and CamelCase."""
    pattern = re.compile(rf"(?<![a-z])({word})(?![a-z])", re.IGNORECASE)
    return [line.strip() for line in text.splitlines() if pattern.search(re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", line))]


@pytest.mark.parametrize("word", RETIRED, ids=RETIRED.values())
def test_retired_words_stay_out(word):
    lines = {str(p.relative_to(ROOT)): found(word, p.read_text(encoding="utf-8")) for p in texts()}
    assert not {path: hits for path, hits in lines.items() if hits}, f"write instead: {RETIRED[word]}"


def test_the_search_sees_names_phrases_and_capitals():
    assert found(r"crew", "    crew_size = 2") == ["crew_size = 2"]
    assert found(r"flaw(s|ed)?", "class FlawedSensor:") == ["class FlawedSensor:"]
    assert found(r"go(es)? on", "It Goes on.") == ["It Goes on."]
    assert not found(r"lanes?", "planes of a plane")
    assert len(texts()) > 300


def test_the_glossary_defines_each_term_once():
    rows = re.findall(r"^\| ([^|]+) \| ([^|]+) \|$", (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8"), re.M)
    terms = [term for term, _ in rows if term not in ("term", "---")]
    assert len(terms) >= 30
    assert len(set(terms)) == len(terms)
