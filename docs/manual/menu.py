"""Makes menus and cards of lists of pages: `<!-- menu -->` above a list of links fills the menu in this order.

`<!-- rooms -->` is replaced by the rooms of the API reference.
"""

from __future__ import annotations

import re

from manual import api, examples

_LIST = re.compile(r"^<!-- menu -->\n\n((?:- \[.*\n(?:  .*\n)*)+)", re.MULTILINE)
_ROOMS = re.compile(r"^<!-- rooms -->$", re.MULTILINE)
_ITEM = re.compile(r"- \[([^\]]+)\]\(([^)]+)\.(?:md|py)\)(?:: )?((?:.|\n(?!- ))*)")


def insert(text: str) -> str:
    """Return a page with cards and a menu in place of each marked list, and the rooms of the API."""
    text = _LIST.sub(lambda found: _cards(_ITEM.findall(found[1])), text)
    return _ROOMS.sub(lambda _: _rooms(), text)


def pages(text: str) -> list[str]:
    """Return the pages that a page puts into the menu."""
    return [page for found in _LIST.findall(text) for _, page, _ in _ITEM.findall(found)]


def _cards(items: list[tuple[str, str, str]]) -> str:
    cards = [
        f":::{{grid-item-card}} {title}\n{_picture(page)}:link: {page}\n:link-type: doc\n\n{' '.join(what.split())}"
        for title, page, what in items
    ]
    grid = "\n\n".join(["::::{grid} 1 2 2 2\n:gutter: 3", *(f"{card}\n:::" for card in cards), "::::"])
    return f"{grid}\n\n{_toctree([page for _, page, _ in items])}"


def _picture(page: str) -> str:
    """Return the option for the last picture of an example, above its card; an empty text for other pages."""
    if not page.startswith("examples/"):
        return ""
    pictures = [name for cell in examples.outputs(page.removeprefix("examples/")) for name in cell.pictures]
    return f":img-top: examples/results/{pictures[-1]}\n" if pictures else ""


def _toctree(pages: list[str]) -> str:
    return "\n".join(["```{toctree}", ":hidden:", ":maxdepth: 1", "", *pages, "```", ""])


def _rooms() -> str:
    """Return a table of the rooms with their charters, and their place in the menu."""
    rooms = [name for name in api.pages() if api.is_room(name) and name.count(".") < 2]
    rows = [f"| [{name}](api/{name}.rst) | {api.charter(name)} |" for name in rooms]
    return "\n".join(["| package | subject |", "|---|---|", *rows, "", _toctree([f"api/{name}" for name in rooms])])
