"""Writes the command reference from the parsers of `qsim` and `quiver`, in place of `<!-- commands: PROGRAM -->`."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator
from importlib import import_module

from qsim.cli.console import options_of

_MARK = re.compile(r"^<!-- commands: (\w+) -->$", re.MULTILINE)
_COMMON = ("--help", "--json", "--quiet", "--verbose")  # of every command: described once, on the page


def insert(text: str) -> str:
    """Return a page with the reference of a program in place of its comment."""
    return _MARK.sub(lambda found: reference(import_module(f"{found[1]}.cli.program").parser()), text)


def reference(parser: argparse.ArgumentParser) -> str:
    """Return the Markdown of all commands of a program."""
    return "\n".join(part for name, own in options_of(parser).commands.items() for part in _command(name, own))


def _command(name: str, parser: argparse.ArgumentParser) -> Iterator[str]:
    """Yield the heading, the usage, the arguments and the examples of a command."""
    options, positional, _ = options_of(parser)
    own = [
        action for action in options if action.option_strings[-1] not in _COMMON and action.help != argparse.SUPPRESS
    ]
    yield f"## {parser.prog}\n\n{_escaped(parser.description or '')}\n"
    yield f"```text\n{_usage(parser, positional, own)}\n```\n"
    for action in (*positional, *own):
        yield f"{_names(action)}\n: {_escaped(_help(parser, action))}\n"
    if parser.epilog:
        example = re.sub(r"^  ", "", parser.epilog.partition("\n")[2], flags=re.MULTILINE).strip()
        yield f"```sh\n{example}\n```\n"


def _usage(parser: argparse.ArgumentParser, positional: list[argparse.Action], own: list[argparse.Action]) -> str:
    """Return the one line of what must be given."""
    words = [parser.prog]
    for action in (*positional, *(a for a in own if a.required)):
        words.append(" ".join([*action.option_strings[:1], _value(action)]).strip())
    return " ".join([*words, "[OPTIONS]"] if own else words)


def _names(action: argparse.Action) -> str:
    """Return the names of an argument and its value, as code."""
    value = _value(action)
    if not action.option_strings:
        return f"`{value}`"
    return ", ".join(f"`{name} {value}`" if value else f"`{name}`" for name in action.option_strings)


def _value(action: argparse.Action) -> str:
    """Return the word for the value of an argument, as `--help` prints it; an empty text for a flag."""
    if action.nargs == 0:
        return ""
    names = action.metavar or (
        "{" + ",".join(map(str, action.choices)) + "}" if action.choices else action.dest.upper()
    )
    if isinstance(names, tuple):
        return " ".join(names)
    if isinstance(action.nargs, int):
        return " ".join([names] * action.nargs)
    return {"+": f"{names} [{names} ...]", "*": f"[{names} ...]", "?": f"[{names}]"}.get(str(action.nargs), names)


def _help(parser: argparse.ArgumentParser, action: argparse.Action) -> str:
    """Return the help of an argument with its default filled in."""
    default = {"default": action.default, "prog": parser.prog}
    text = (action.help or "") % default if "%" in (action.help or "") else action.help or ""
    return text[:1].upper() + text[1:] + "." * (not text.endswith("."))


def _escaped(text: str) -> str:
    """Return a text of `--help` as Markdown: characters with a meaning are escaped outside of code."""
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(part if part[:1] == "`" else re.sub(r"([*_<>\[\]|$\\])", r"\\\1", part) for part in parts)
