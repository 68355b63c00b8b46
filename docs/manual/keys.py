"""Writes tables of the keys of recipes and of sensor files: those that `qsim recipes --keys` and the like print."""

from __future__ import annotations

from qsim.cli.documented_keys import Key


def table(rows: list[Key]) -> str:
    """Return a Markdown table of keys."""
    lines = ["| key | accepts | meaning |", "|---|---|---|"]
    for key in rows:
        needed = "**Required.** " if key.needed else ""
        cells = (f"`{key.name} = {key.example}`", key.accepts, needed + key.meaning[:1].upper() + key.meaning[1:])
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines)
