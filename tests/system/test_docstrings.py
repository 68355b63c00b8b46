"""Docstrings state the shapes of arrays: type hints do not, and no checker of shapes runs (CONTRIBUTING.md)."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
BOUNDARIES = ("qsim/optics", "qsim/sensor", "qsim/clip", "qsim/streams", "quiver/model")
ARRAYS = re.compile(r"\b(Array|NDArray|ndarray|ArrayLike|Tensor)\b")
SHAPES = re.compile(
    r"\[[^\]]+\]|\bshape\b|\bscalars?\b|\bbroadcast|\bAs `|\bSee `"
)  # or the docstring that it refers to


def public_functions(tree: ast.AST) -> Iterator[ast.FunctionDef]:
    """Functions and methods without a leading underscore, in public classes."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from public_functions(node)
        elif isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            yield node


def takes_or_returns_arrays(function: ast.FunctionDef) -> bool:
    arguments = [*function.args.args, *function.args.kwonlyargs]
    hints = [hint for hint in (*(a.annotation for a in arguments), function.returns) if hint]
    return any(ARRAYS.search(ast.unparse(hint)) for hint in hints)


def silent(*texts: str) -> list[str]:
    """Names of a room's functions without a docstring that states shapes; one such serves its overrides too."""
    functions = [f for text in texts for f in public_functions(ast.parse(text)) if takes_or_returns_arrays(f)]
    stated = {f.name for f in functions if SHAPES.search(ast.get_docstring(f) or "")}
    return sorted({f.name for f in functions} - stated)


def test_public_functions_state_the_shapes_of_arrays():
    modules = {room: [p.read_text(encoding="utf-8") for p in (ROOT / room).rglob("*.py")] for room in BOUNDARIES}
    assert sum(map(len, modules.values())) > 35
    assert not {room: silent(*texts) for room, texts in modules.items() if silent(*texts)}


def test_the_check_sees_methods_and_missing_docstrings():
    text = (
        "class A:\n    def f(self, x: Array) -> float:\n        'Return a number.'\n"
        "def g(x: int): ...\ndef h() -> Tensor: ...\n"
    )
    assert silent(text) == ["f", "h"]
    assert silent(text.replace("a number", "the mean of x [H, W]")) == ["h"]
