"""Writes tables of the keys of recipes and of `[defects]`, in place of `<!-- keys: SECTION -->`.

The keys are those that `qsim recipes --keys` and `qsim sensors --keys` print.
"""

from __future__ import annotations

import re

from qsim.cli.documented_keys import Key, keys

_MARK = re.compile(r"^<!-- keys: (\[\S+\]) -->$", re.MULTILINE)


def insert(text: str) -> str:
    """Return a page with tables in place of its comments."""
    return _MARK.sub(lambda found: table(keys(found[1])), text)


def table(rows: list[Key]) -> str:
    """Return a Markdown table of keys."""
    lines = ["| key | accepts | meaning |", "|---|---|---|"]
    for key in rows:
        needed = "**Required.** " if key.needed else ""
        cells = (f"`{key.name} = {key.example}`", key.accepts, needed + key.meaning[:1].upper() + key.meaning[1:])
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines)
