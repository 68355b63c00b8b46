"""Makes pages and notebooks of the examples: Python files whose cells are separated by `# %%`.

A cell's leading comment is Markdown, the rest is code. `python docs/run_examples.py` runs the cells and stores what
they print and draw (examples/results/); nothing runs while the manual is built. A line such as

    side = 128  # tests: 32

has another value in the tests; pages and notebooks leave the comment out.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
from pathlib import Path
from typing import Any, NamedTuple

FOLDER = Path(__file__).parents[1] / "examples"
RESULTS = FOLDER / "results"
_TESTS = re.compile(r"^(.*? = )(.*?)  # tests: (.*)$", re.MULTILINE)


class Cell(NamedTuple):
    """A part of an example: explanation, then code."""

    text: str
    code: str


class Output(NamedTuple):
    """The result of a cell: what it printed, and the names of its pictures."""

    printed: str
    pictures: list[str]


def cells(source: str) -> list[Cell]:
    """Return the cells of an example; the first is its docstring."""
    _, title, rest = source.split('"""', 2)
    found = [Cell(title.strip(), "")]
    for part in re.split(r"^# %%\n", rest, flags=re.MULTILINE)[1:]:
        lines = part.strip("\n").split("\n")
        count = next((n for n, line in enumerate(lines) if not line.startswith("#")), len(lines))
        text = "\n".join(line.removeprefix("#").removeprefix(" ") for line in lines[:count])
        found.append(Cell(text, "\n".join(lines[count:]).strip("\n")))
    return found


def small(source: str) -> str:
    """Return an example with the values of the tests."""
    return _TESTS.sub(r"\1\3", source)


def shown(code: str) -> str:
    """Return code as readers see it."""
    return _TESTS.sub(r"\1\2", code)


def digest(source: str) -> str:
    """Return the checksum of an example's code; its text may change without another run."""
    code = "\n".join(shown(cell.code) for cell in cells(source))
    return hashlib.sha256(code.encode()).hexdigest()[:16]


def stored(name: str) -> dict[str, Any]:
    """Return the digest ("code") and the results ("cells") of an example's last run; empty if there was none."""
    path = RESULTS / f"{name}.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def outputs(name: str) -> list[Output]:
    """Return the stored results of an example's cells."""
    return [Output(*one) for one in stored(name).get("cells", [])]


def page(name: str) -> str:
    """Return the Markdown of an example with its stored results, and links to the file and the notebook."""
    parts = []
    results = outputs(name)
    for number, cell in enumerate(cells((FOLDER / f"{name}.py").read_text(encoding="utf-8"))):
        parts.append(cell.text)
        if number == 0:
            links = {"a notebook": f"{name}.ipynb", "a program": f"{name}.py"}
            parts.append(
                " · ".join(f'<a href="{file}" download>Download as {what}</a>' for what, file in links.items())
            )
        if cell.code:
            parts.append(f"```python\n{shown(cell.code)}\n```")
        if number < len(results):
            found = results[number]
            parts += [f"```text\n{found.printed.rstrip()}\n```"] if found.printed.strip() else []
            parts += [f"![Result of the cell above](results/{picture})" for picture in found.pictures]
    return "\n\n".join(part for part in parts if part) + "\n"


def notebook(name: str) -> dict[str, Any]:
    """Return an example as a notebook (format 4.5) with its stored results."""
    results = outputs(name)
    made: list[dict[str, Any]] = []
    for number, cell in enumerate(cells((FOLDER / f"{name}.py").read_text(encoding="utf-8"))):
        if cell.text:
            made.append({"cell_type": "markdown", "id": f"text-{number}", "metadata": {}, "source": cell.text})
        if cell.code:
            found = results[number] if number < len(results) else Output("", [])
            made.append(
                {
                    "cell_type": "code",
                    "id": f"code-{number}",
                    "metadata": {},
                    "execution_count": None,
                    "source": shown(cell.code),
                    "outputs": _results(found),
                }
            )
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return {"cells": made, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}


def _results(found: Output) -> list[dict[str, Any]]:
    printed = [{"output_type": "stream", "name": "stdout", "text": found.printed}] if found.printed else []
    return [*printed, *(_picture(RESULTS / name) for name in found.pictures)]


def _picture(path: Path) -> dict[str, Any]:
    kind = "image/png" if path.suffix == ".png" else "image/jpeg"
    data = {kind: base64.b64encode(path.read_bytes()).decode()}
    return {"output_type": "display_data", "data": data, "metadata": {}}


def write_downloads(app: Any, error: Exception | None) -> None:
    """Write the notebooks and programs beside the pages, once these are built."""
    if error is None and app.builder.format == "html":
        for path in FOLDER.glob("*.py"):
            folder = Path(app.outdir) / "examples"
            (folder / f"{path.stem}.ipynb").write_text(json.dumps(notebook(path.stem), indent=1), encoding="utf-8")
            (folder / path.name).write_text(shown(path.read_text(encoding="utf-8")), encoding="utf-8")
