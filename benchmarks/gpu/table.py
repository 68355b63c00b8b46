"""Writes all records of a folder as one table in Markdown and JSON."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from folder import read, read_record, write
from job import SECTIONS


def write_tables(out: Path) -> None:
    """Write table.json and table.md; records that are missing or damaged are left out."""
    records = {section: records_of(out / section) for section in SECTIONS}
    machine = (read(out / "machine.json") or {}).get("machine", {})
    text = "\n".join(page(machine, records)).rstrip() + "\n"
    temporary = out / f"table.md.json.tmp-{os.getpid()}"
    temporary.write_text(text, encoding="utf-8")
    os.replace(temporary, out / "table.md")
    write(out / "table.json", {"machine": machine, "records": records})


def records_of(folder: Path) -> dict[str, dict[str, Any]]:
    """Return the records of a section by name, in the order in which they were made."""
    files = sorted(folder.glob("*.json"), key=lambda file: (file.stat().st_mtime_ns, file.name))
    found = {file.stem: read_record(file) for file in files}
    return {name: record for name, record in found.items() if record is not None}


def page(machine: dict[str, Any], records: dict[str, dict[str, dict[str, Any]]]) -> list[str]:
    """Return the lines of the page: machine, then for each section its tables and what was not measured."""
    made = [record for section in records.values() for record in section.values()]
    programs = sorted({str(record["setup"].get("program")) for record in made})
    commands = sorted({str(record["command"]) for record in made})
    lines = [f"# {', '.join(machine.get('gpus') or ()) or machine.get('processor', 'unknown machine')}", ""]
    lines += [
        f"- {key}: {value if not isinstance(value, list) else '; '.join(value) or 'none'}"
        for key, value in machine.items()
    ]
    lines += [f"- command: `{command}`" for command in commands] + [f"- program: {', '.join(programs)}", ""]
    for section, found in records.items():
        if found:
            lines += [f"## {section}", ""]
            rows = [row for record in found.values() for row in rows_of(record)]
            for columns in dict.fromkeys(tuple(row) for row in rows):
                lines += [*table(columns, [row for row in rows if tuple(row) == columns]), ""]
            open_ones = {name: record for name, record in found.items() if record["state"] != "done"}
            lines += [
                f"- {name}: {record['state']}: {record.get('why') or 'the next piece continues it'}"
                for name, record in open_ones.items()
            ] + [""]
    return lines


def rows_of(record: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of a record; none if it is damaged."""
    rows = record.get("rows")
    return [row for row in rows if isinstance(row, dict)] if isinstance(rows, list) else []


def table(columns: tuple[str, ...], rows: list[dict[str, Any]]) -> list[str]:
    """Return the lines of a Markdown table."""
    lines = [[*columns], ["---"] * len(columns), *([shown(row[name]) for name in columns] for row in rows)]
    return ["| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines]


def shown(value: Any) -> str:
    """Return a cell: four digits of a number, nothing for None."""
    if value is None:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)
