"""Typesets formulas as MathML while the manual is built: no script, no network, no pictures."""

from __future__ import annotations

from typing import Any

from latex2mathml.converter import convert


def setup(app: Any) -> None:
    """Make `html_math_renderer = "mathml"` known to Sphinx."""
    app.add_html_math_renderer("mathml", inline_renderers=(_inline, None), block_renderers=(_block, None))


def typeset(formula: str, *, display: str = "inline") -> str:
    """Return a formula in LaTeX's notation as MathML; `display` is inline or block."""
    return convert(formula, display=display)


def _inline(writer: Any, node: Any) -> None:
    from docutils.nodes import SkipNode

    writer.body.append(typeset(node.astext()))
    raise SkipNode


def _block(writer: Any, node: Any) -> None:
    from docutils.nodes import SkipNode

    writer.body.append(f'<div class="math">{typeset(node.astext(), display="block")}</div>')
    raise SkipNode
