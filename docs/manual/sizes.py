"""Counts lines and words of each room at two commits, and prints them as a table.

    python docs/manual/sizes.py BEFORE [AFTER]     # AFTER is HEAD by default

A room is a folder of `qsim`, `quiver` or the tests; the files beside the rooms are the ground floor. Words are what
spaces part, comments and docstrings included. Programs that measure stand beside each other wherever they lie.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from qsim.tables import markdown_table  # noqa: E402

COUNTED = (".py", ".pyi", ".md", ".html")


def room_of(path: str) -> str | None:
    """Return the room of a file, None for one that does not count."""
    file = Path(path)
    parts = file.parts
    if file.suffix not in COUNTED or "results" in parts:
        return None
    if file.suffix == ".md":
        return "prose"
    if parts[0] in ("qsim", "quiver"):
        return "/".join(parts[:2]) if len(parts) > 2 else f"{parts[0]}, ground floor"
    if parts[0] == "tests":
        return "/".join(parts[:2]) if len(parts) > 2 else "tests"
    if parts[0] in ("docs", "benchmarks"):
        return "examples" if "examples" in parts else "programs that measure and make pages"
    return "scenes" if parts[0] == "scenes" else None


def sizes(commit: str) -> tuple[Counter[str], Counter[str]]:
    """Return lines and words by room at a commit."""
    lines: Counter[str] = Counter()
    words: Counter[str] = Counter()
    for path in _git("ls-tree", "-r", "--name-only", commit).splitlines():
        room = room_of(path)
        if room is not None:
            text = _git("show", f"{commit}:{path}")
            lines[room] += text.count("\n")
            words[room] += len(text.split())
    return lines, words


def _git(*words: str) -> str:
    return subprocess.run(["git", "-C", str(ROOT), *words], check=True, capture_output=True, text=True).stdout


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before")
    parser.add_argument("after", nargs="?", default="HEAD")
    asked = parser.parse_args()
    old_lines, old_words = sizes(asked.before)
    lines, words = sizes(asked.after)
    rows = [
        [room, f"{old_lines[room]:,}", f"{lines[room]:,}", f"{old_words[room]:,}", f"{words[room]:,}"]
        for room in sorted(old_lines.keys() | lines.keys())
    ]
    totals = [f"{sum(each.values()):,}" for each in (old_lines, lines, old_words, words)]
    header = ("room", "lines before", "after", "words before", "after")
    print("\n".join(markdown_table([*rows, ["all", *totals]], header)))


if __name__ == "__main__":
    main()
