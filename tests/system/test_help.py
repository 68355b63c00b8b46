"""Tests of `--help`: the commonest options come first, and examples are read as they stand."""

import re
import shlex

import pytest

import qsim.cli.program
import quiver.cli.program
from qsim.cli.usage import Program

PROGRAMS = (qsim.cli.program.PROGRAM, quiver.cli.program.PROGRAM)
COMMANDS = [(program, name) for program in PROGRAMS for name in program.commands]


def words_of(example: str) -> list[str]:
    """Return the words of an example behind the name of its program, without comments and redirections."""
    words = shlex.split(example, comments=True)
    words = words[: next((i for i, word in enumerate(words) if word.startswith(">")), len(words))]
    return words[next(i for i, word in enumerate(words) if word in ("qsim", "quiver")) + 1 :]


def options_in(help_: str) -> list[list[str]]:
    """Return the spellings of each option below the heading `options:`, in order, but those that every command has."""
    (section,) = re.findall(r"^options:\n((?:  .*\n)+)", f"{help_}\n", re.MULTILINE)
    rows = [re.split(r"  +", line.strip())[0] for line in section.splitlines() if line.startswith("  -")]
    found = [re.findall(r"(?<!\S)--?[a-z][a-z-]*", row) for row in rows]
    return [names for names in found if not {"--help", "--json", "--quiet", "--verbose"} & set(names)]


@pytest.mark.parametrize(("program", "name"), COMMANDS, ids=lambda value: getattr(value, "name", value))
def test_options_of_more_examples_come_first(program: Program, name: str):
    examples = [words_of(example) for example in program.declared(name).examples]
    uses = [sum(bool(set(names) & set(words)) for words in examples) for names in options_in(program.help(name))]
    assert uses == sorted(uses, reverse=True)


def test_the_commonest_options_of_some_commands():
    first = {name: [names[-1] for names in options_in(program.help(name))][:3] for program, name in COMMANDS}
    assert first["train"] == ["--output", "--minutes", "--preset"]
    assert first["sense"] == ["--bits", "--ppp", "--sensor"]
    assert first["restore"] == ["--output", "--method", "--ppp"]


@pytest.mark.parametrize(("program", "name"), COMMANDS, ids=lambda value: getattr(value, "name", value))
def test_examples_are_read(program: Program, name: str):
    for example in program.declared(name).examples:
        found, values = program.read(words_of(example))
        assert found is program.declared(name)
        found.arguments(values)
