"""Writes the list of rooms and files in docs/map.md from the first sentence of every docstring.

python docs/map.py
"""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "map.md"
MARK = "<!-- written by `python docs/map.py` from the docstrings -->\n"


def first_sentence(path: Path) -> str:
    """The first line of a module's docstring."""
    return (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").partition("\n")[0]


def rooms() -> list[Path]:
    """Every folder that is a package."""
    return [p.parent for name in ("qsim", "quiver", "scenes") for p in sorted((ROOT / name).rglob("__init__.py"))]


def files() -> str:
    """One heading for every room with its charter, one line for every file in it."""
    parts = []
    for room in rooms():
        parts.append(f"### {room.relative_to(ROOT)}/\n\n{first_sentence(room / '__init__.py')}\n")
        lines = [f"- `{p.name}` – {first_sentence(p)}" for p in sorted(room.glob("*.py")) if p.name[:2] != "__"]
        parts.append("\n".join(lines) + "\n")
    return "\n".join(parts)


def page(text: str) -> str:
    """Return the page with its list written again; the text before the mark is kept."""
    return text.partition(MARK)[0] + MARK + "\n" + files()


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
