"""Reads command lines with cyclopts, and words in one line what is wrong with one.

qsim sense: unknown option --sensr (did you mean '--sensor'?); see qsim sense --help
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from cyclopts import App, CoercionError, CycloptsError, MissingArgumentError, RepeatArgumentError, UnknownOptionError
from cyclopts.exceptions import UnknownCommandError, UnusedCliTokensError

from qsim.checks import suggest
from qsim.cli.command import Command
from qsim.cli.help import command_help, program_help
from qsim.cli.setting_options import no_choice, option_names
from qsim.terminal import printable

ALWAYS = ["-h", "--help", "--version"]

# Names of options in other programs -> ours, suggested if the command has ours.
_ALSO_CALLED = {
    "--fps": "--frame-rate",
    "--framerate": "--frame-rate",
    "--resolution": "--height",
    "--overwrite": "--force",
    "--yes": "--force",
    "--jobs": "--workers",
    "--processes": "--workers",
    "--gpu": "--device",
    "--cuda": "--device",
    "--epochs": "--steps",
    "--lr": "--learning-rate",
    "--photons": "--ppp",
    "--light": "--ppp",
    "--model": "--method",
    "--weights": "--method",
    "--debug": "--verbose",
    "--silent": "--quiet",
}


class UsageError(Exception):
    """Wrong options or arguments, in one line."""


@dataclass(frozen=True)
class Program:
    """The commands of a program; the module of a command is imported when the command is used."""

    name: str
    what: str
    version: str
    commands: Mapping[str, tuple[str, str]]  # `module:function` of each, and its line of help
    guard: Callable[[Command], AbstractContextManager[Any]] = nullcontext  # around the work of a command

    @cached_property
    def app(self) -> App:
        """The application of cyclopts that reads command lines."""
        app = _App(name=self.name, help=self.what, version=f"{self.name} {self.version}", help_format="plaintext")
        app.program = self
        for name, (place, words) in self.commands.items():
            app.command(place, name=name, help=words)
        return app

    def declared(self, name: str) -> Command:
        """Return the declaration of a command."""
        found: Command = self.app[name].default_command.declared  # type: ignore[union-attr]
        return found

    def options(self) -> dict[str, str]:
        """Return the options of all commands by the names of their arguments; their modules are imported."""
        return {name: option for one in self.commands for name, option in self.declared(one).options.items()}

    def help(self, name: str = "") -> str:
        """Return the help of the program, or of one of its commands."""
        if not name:
            return program_help(self.name, self.what, {name: words for name, (_, words) in self.commands.items()})
        return command_help(f"{self.name} {name}", self.commands[name][1], self.declared(name))

    def read(self, words: Sequence[str]) -> tuple[Command | None, dict[str, Any]]:
        """Return the command of a line and the values of its settings; None after help or version were printed.

        `UsageError` for a line that names no command, or whose options or arguments are wrong.
        """
        try:
            action, bound, _ = self.app.parse_args(list(words), print_error=False, exit_on_error=False)
        except CycloptsError as error:
            place = " ".join((self.name, *(error.command_chain or ())))
            raise UsageError(f"{place}: {self._wrong(error)}; see {place} --help") from error
        declared = getattr(action, "declared", None)
        if declared is None:
            action(*bound.args, **bound.kwargs)
            return None, {}
        values = dict(bound.arguments)
        if values.get("quiet") and values.get("verbose"):
            raise UsageError(f"{self.name}: argument --verbose: not allowed with --quiet; leave one of them out")
        return declared, values

    def _wrong(self, error: CycloptsError) -> str:
        """Return what is wrong with a command line."""
        unused = (error.unused_tokens or [""])[0]
        match error:
            case UnknownCommandError() if unused.startswith("-"):
                return f"unknown option {unused}{suggest(unused, ('--help', '--version'))}"
            case UnknownCommandError():
                known = ", ".join(self.commands)
                return f"unknown command '{unused}'{suggest(unused, self.commands)}; there are: {known}"
            case UnknownOptionError():
                return self._unknown_option(error.token.keyword or error.token.value, error)
            case MissingArgumentError():
                return self._missing(error)
            case UnusedCliTokensError():
                return f"unexpected argument {unused}"
            case RepeatArgumentError():
                return f"argument {error.token.keyword}: not allowed with its opposite; leave one of them out"
            case CoercionError():
                return self._unfit(error)
        return " ".join(str(error).split())

    def _missing(self, error: MissingArgumentError) -> str:
        """Return the sentence about an argument that is not given, or whose name is misspelt."""
        for word in error.unused_tokens or ():
            if word.startswith("--") and word.split("=")[0] not in self._options(error):
                return self._unknown_option(word, error)
        argument = _name_of(error)
        if argument.startswith("-") and (error.keyword or (error.argument and error.argument.tokens)):
            return f"argument {argument}: needs a value"
        return f"the following arguments are required: {argument}"

    def _unfit(self, error: CoercionError) -> str:
        """Return the sentence about a value that does not fit its argument."""
        argument = _name_of(error)
        if error.msg is not None:
            return f"argument {argument}: {error.msg}"
        if error.token is None:
            return " ".join(str(error).split())
        choices = error.argument.parameter.choices if error.argument is not None else None
        if isinstance(choices, tuple):
            return f"argument {argument}: {no_choice(error.token.value, choices)}"
        return f"argument {argument}: takes no value, got {error.token.value!r}"

    def _options(self, error: CycloptsError) -> list[str]:
        """Return every option of the command that an error is about."""
        command = self.declared((error.command_chain or ("",))[0])
        return [name for one in command.settings if not one.positional for name in option_names(one)] + ALWAYS

    def _unknown_option(self, word: str, error: CycloptsError) -> str:
        """Return the sentence about an option that a command lacks, with the one that was meant."""
        option = word.split("=")[0]
        known = self._options(error)
        meant = _ALSO_CALLED.get(option, "")
        return f"unknown option {option}{suggest(meant if meant in known else option, known)}"


class _App(App):
    """An application whose help is plain text, in a terminal as in a pipe."""

    program: Program

    def help_print(self, tokens: Any = None, *, console: Any = None) -> None:
        """Print the help of the program, or of the command that the tokens name."""
        chain = self.parse_commands(tokens)[0]
        print(printable(self.program.help(*chain[:1])))


def _name_of(error: CycloptsError) -> str:
    """Return the argument that an error is about, by its first long name."""
    if error.argument is None:
        return ""
    names = list(error.argument.names)
    return next((name for name in names if name.startswith("--")), names[0])
