"""Messages of the library speak of arguments and values; only the command rooms know options.

`qsim.cli.command.Command.in_options` replaces `ppp=3.25` by `--ppp 3.25`, and `force=True` by `--force`.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

import qsim.cli.program
from qsim.checks import ArgumentError

ROOT = Path(__file__).parents[2]
OPTION = re.compile(r"(?<![\w(.-])--(?:[a-z]|$)|\s-o\b")


def sentences(path: Path) -> list[tuple[int, str]]:
    """The string literals of a source file, but for docstrings, with their lines."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    texts = [node for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    described = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    first = [node.body[0] for node in ast.walk(tree) if isinstance(node, described) and node.body]
    docs = {id(statement.value) for statement in first if isinstance(statement, ast.Expr)}
    return [(node.lineno, str(node.value)) for node in texts if id(node) not in docs]


def test_no_message_outside_of_the_command_rooms_names_an_option():
    found = []
    for package in ("qsim", "quiver"):
        for path in sorted((ROOT / package).rglob("*.py")):
            if "cli" not in path.parts:
                found += [f"{path.relative_to(ROOT)}:{n}: {text}" for n, text in sentences(path) if OPTION.search(text)]
    assert not found


@pytest.mark.parametrize("text", ["give --bits", "name another with -o", "--force replaces it"])
def test_the_check_would_notice(text):
    assert OPTION.search(text)


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (ValueError("x: as in bits=3, or ppp="), "x: as in --bits 3, or --ppp"),
        (ValueError("x: exists; replace it with force=True"), "x: exists; replace it with --force"),
        (ValueError("give row_delay=1e-6."), "give --row-delay 1e-6."),
        (ValueError("QIS(gain=2.0, bits=3) has no law"), "QIS(gain=2.0, bits=3) has no law"),
        (ArgumentError("row_order", "changes nothing"), "--row-order: changes nothing"),
        (ValueError("name the layout=: cube"), "name the --layout: cube"),  # of another command
        (ValueError("give sensor= and scale= in Python"), "give --sensor and --scale in Python"),
        (ValueError("code=3 is none"), "code=3 is none"),
    ],
)
def test_commands_name_their_options(error, told):
    program = qsim.cli.program.PROGRAM
    assert program.declared("sense").in_options(error, str(error), program.options) == told
