"""Runs the examples of the manual and stores what they print and draw, for pages and notebooks.

python docs/run_examples.py [NAME ...]     # all whose code has changed since they were run; about a minute each
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import sys
import tempfile
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parent)]

from manual import examples  # noqa: E402

LARGEST_PNG = 60_000  # bytes; larger pictures are stored as JPEG


def main(names: list[str]) -> None:
    examples.RESULTS.mkdir(exist_ok=True)
    paths = sorted(examples.FOLDER.glob("*.py"))
    unknown = sorted({*names} - {path.stem for path in paths})
    if unknown:
        sys.exit(f"run_examples: no example is called {unknown[0]!r}; known are {', '.join(p.stem for p in paths)}")
    for path in paths:
        name = path.stem
        source = path.read_text(encoding="utf-8")
        code = examples.digest(source)
        if name in names or (not names and examples.stored(name).get("code") != code):
            print(name, flush=True)
            earlier = {*examples.RESULTS.glob(f"{name}_[0-9]*")}
            cells = run(name, source)
            text = json.dumps({"code": code, "cells": cells}, indent=1, ensure_ascii=False) + "\n"
            (examples.RESULTS / f"{name}.json").write_text(text, encoding="utf-8")
            for old in earlier - {examples.RESULTS / str(picture) for _, pictures in cells for picture in pictures}:
                old.unlink()


def run(name: str, source: str) -> list[tuple[str, list[str]]]:
    """Run the cells of an example in an empty folder; return what each printed and the names of its pictures."""
    found: list[tuple[str, list[str]]] = []
    space: dict[str, object] = {"__name__": "__main__"}
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for number, cell in enumerate(examples.cells(source)):
            printed = io.StringIO()
            with contextlib.redirect_stdout(printed):
                exec(compile(examples.shown(cell.code), f"{name}, cell {number}", "exec", dont_inherit=True), space)
            text = printed.getvalue().replace(os.path.realpath(folder), "").replace(folder, "")
            found.append((text, save_figures(f"{name}_{number}")))
    return found


def save_figures(stem: str) -> list[str]:
    """Save the open figures and close them; return the names of their files."""
    import matplotlib.pyplot as plt

    names = []
    for number, figure in enumerate(plt.get_fignums()):
        path = examples.RESULTS / f"{stem}{'abcdefgh'[number] if number else ''}.png"
        plt.figure(figure).savefig(path, dpi=100)
        if path.stat().st_size > LARGEST_PNG:
            path.unlink()
            path = path.with_suffix(".jpg")
            plt.figure(figure).savefig(path, dpi=100, pil_kwargs={"quality": 88, "optimize": True})
        names.append(path.name)
    plt.close("all")
    return names


if __name__ == "__main__":
    main(sys.argv[1:])
