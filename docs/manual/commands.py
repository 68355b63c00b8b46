"""Writes the command reference from the declared settings."""

from __future__ import annotations

import re
from collections.abc import Iterator

from qsim.cli.command import Printing
from qsim.cli.help import help_of, spellings, usage
from qsim.cli.setting_options import value_word
from qsim.cli.usage import Program
from qsim.settings import Setting, settings_of


def reference(program: Program) -> str:
    """Return the Markdown of all commands of a program."""
    return "\n".join(part for name in program.commands for part in _command(program, name))


def _command(program: Program, name: str) -> Iterator[str]:
    """Yield the heading, the usage, the arguments and the examples of a command.

    The options of every command are described once, on the page.
    """
    command = program.declared(name)
    common = {setting.name for setting in settings_of(Printing)}
    yield f"## {program.name} {name}\n\n{_escaped(program.commands[name][1])}\n"
    yield f"```text\n{usage(f'{program.name} {name}', command)}\n```\n"
    for setting in sorted(command.settings, key=lambda one: not one.positional):
        if setting.name not in common:
            yield f"{_names(setting)}\n: {_escaped(_sentence(help_of(setting)))}\n"
    examples = "\n".join(command.examples)
    yield f"```text\n{examples}\n```\n"  # the tests run what pages have as `sh`


def _names(setting: Setting) -> str:
    """Return the names of an argument and its value, as code."""
    names = [value_word(setting)] if setting.positional else spellings(setting)
    return ", ".join(f"`{name}`" for name in names)


def _sentence(text: str) -> str:
    """Return a line of help as a sentence."""
    return text[:1].upper() + text[1:] + "." * (not text.endswith("."))


def _escaped(text: str) -> str:
    """Return a text of `--help` as Markdown: outside of code characters are escaped, and options become code."""
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(part if part[:1] == "`" else _plain(part) for part in parts)


def _plain(text: str) -> str:
    """Return a text without code as Markdown; plain dashes of an option would be set as one dash."""
    escaped = re.sub(r"([*_<>\[\]|$\\])", r"\\\1", text)
    return re.sub(r"(?<![\w-])--[a-z][a-z-]*", r"`\g<0>`", escaped)
