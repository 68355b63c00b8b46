"""Builds the manual: what Sphinx needs beyond its own extensions. `make docs` builds; nothing is executed or fetched.

Pages are Markdown. `<!-- page: ../scenes/README.md -->` is replaced by that page. Parts that come from the code stand
in the pages (generated.py).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from manual import api, examples, mathml, menu

_PAGE = re.compile(r"^<!-- page: (\S+) -->$", re.MULTILINE)
_SHELL = re.compile(r"^```sh\n.*?^```$", re.MULTILINE | re.DOTALL)
_COMMANDS = re.compile(r'<div class="highlight-sh .*?</pre>', re.DOTALL)
_TEXT = re.compile(r"(?<=>)[^<]+")
_HYPHENED = re.compile(r"(?<![\w-])(?:--?[a-z][\w-]*|\w+(?:-\w+)+)")  # an option, or a name such as qbp-bm3d
_BEHIND = re.compile(r"(?<!\\\n)^(\S.*?) {2,}(# .*)$", re.MULTILINE)


def setup(app: Any) -> dict[str, Any]:
    """Connect the parts to Sphinx."""
    app.connect("builder-inited", api.write_pages)
    app.connect("autodoc-process-docstring", api.convert_docstring)
    app.connect("source-read", _insert)
    app.connect("html-page-context", _keep_names)
    app.connect("build-finished", examples.write_downloads)
    mathml.setup(app)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def moved(path: Path) -> str:
    """Return a page beside docs/ with its links as seen from docs/."""
    return path.read_text(encoding="utf-8").replace("](../docs/", "](")


def _insert(app: Any, page: str, source: list[str]) -> None:
    """Replace the comments of a page by what they name; an example becomes its page."""
    if page.startswith("examples/"):
        source[0] = examples.page(page.removeprefix("examples/"))
    source[0] = _PAGE.sub(lambda found: moved(Path(app.srcdir) / found[1]), source[0])
    source[0] = comments_above(menu.insert(source[0]))


def comments_above(text: str) -> str:
    """Return a page whose comments behind shell commands stand above them, where phones show them in one piece."""
    return _SHELL.sub(lambda block: _BEHIND.sub(r"\2\n\1", block[0]), text)


def _keep_names(app: Any, page: str, template: str, context: dict[str, Any], tree: Any) -> None:
    """Keep the options and names in a page's commands in one line each."""
    if "body" in context:
        context["body"] = names_in_one_piece(context["body"])


def names_in_one_piece(html: str) -> str:
    """Return a page with marked names in shell commands: browsers would break `--bits` at its dashes."""

    def marked(text: re.Match[str]) -> str:
        return _HYPHENED.sub(r'<span class="name">\g<0></span>', text[0])

    return _COMMANDS.sub(lambda block: _TEXT.sub(marked, block[0]), html)
