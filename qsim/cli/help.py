"""Writes the help of programs and commands as plain text of 80 columns, made from the declared settings."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping
from textwrap import fill, wrap

from qsim.cli.command import Command
from qsim.cli.setting_options import choices_of, option_names, value_word
from qsim.settings import Setting

COLUMN = 24  # where the texts begin
WIDEST = 100
ALWAYS = (("-h, --help", "print this help and exit"),)


def program_help(name: str, what: str, commands: Mapping[str, str]) -> str:
    """Return the help of a program: its commands, a line each."""
    options = (*ALWAYS, ("--version", "print the version and exit"))
    parts = [f"usage: {name} COMMAND [OPTIONS]", fill(what, _width())]
    parts += [_section("commands", commands.items()), _section("options", options)]
    return "\n\n".join(parts)


def command_help(name: str, what: str, command: Command) -> str:
    """Return the help of a command: what it does, its arguments and options, and examples."""
    positional = [setting for setting in command.settings if setting.positional]
    options = [setting for setting in command.settings if not setting.positional]
    parts = [fill(f"usage: {usage(name, command)}", _width(), subsequent_indent="    "), fill(what, _width())]
    if positional:
        rows = [(value_word(setting), help_of(setting)) for setting in positional]
        parts.append(_section("arguments", rows))
    for section in dict.fromkeys(["", *(setting.section for setting in options)]):
        rows = [_row(setting) for setting in options if setting.section == section]
        parts.append(_section(section or "options", rows if section else [*ALWAYS, *rows]))
    parts.append("\n".join(["example:", *(f"  {line}" for line in command.examples)]))
    return "\n\n".join(parts)


def usage(name: str, command: Command) -> str:
    """Return the one line of what must be given."""
    words = [name]
    for setting in command.settings:
        if setting.positional:
            words.append(value_word(setting))
        elif setting.required:
            words.append(f"{option_names(setting)[0]} {value_word(setting)}")
    return " ".join([*words, "[OPTIONS]"])


def spellings(setting: Setting) -> list[str]:
    """Return the spellings of an option, each with the word for its value."""
    word = value_word(setting)
    return [f"{name} {word}".strip() for name in option_names(setting)]


def _row(setting: Setting) -> tuple[str, str]:
    names = option_names(setting)
    return f"{', '.join(names)} {value_word(setting)}".strip(), help_of(setting)


def help_of(setting: Setting) -> str:
    """Return the line of help of a setting, with its default and with choices that are too long for a name."""
    text = setting.help_with_default
    if setting.varied:
        text += "; several with commas between them"
    choices = choices_of(setting)
    listed = "{" + ",".join(choices) + "}"
    if not choices or setting.shown or listed in value_word(setting):
        return text
    return f"{text}; there are: {', '.join(choices)}"


def _section(title: str, rows: Iterable[tuple[str, str]]) -> str:
    """Return a heading and rows of a name and its text, which begins in its own column or on the next line."""
    lines = [f"{title}:"]
    for name, text in rows:
        wrapped = wrap(text, _width() - COLUMN) or [""]
        if len(name) + 4 > COLUMN:
            lines.append(f"  {name}")
        else:
            lines.append(f"  {name:{COLUMN - 2}}{wrapped.pop(0)}".rstrip())
        lines += [" " * COLUMN + line for line in wrapped]
    return "\n".join(lines)


def _width() -> int:
    """Return the columns of the terminal, 80 without one."""
    return min(shutil.get_terminal_size((80, 24)).columns, WIDEST)
