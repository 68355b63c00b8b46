"""Declares commands: typed functions whose parameters are records of settings.

    @command("qsim compare out/fan")
    def compare(asked: Compare) -> int: ...

The options of a command are the settings of its records, and those that all commands have. cyclopts finds commands by
the names of their modules (program.py), so that a module is imported when its command runs.
"""

from __future__ import annotations

import inspect
import re
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, make_dataclass, replace
from typing import Annotated, Any, NamedTuple, get_args, get_origin, get_type_hints

from qsim.checks import ArgumentError
from qsim.cli.setting_options import option_names, parameter_of, record_of, records_of
from qsim.settings import Setting, setting, settings_of

_ARGUMENT = re.compile(r"(?P<call>\b\w+\([^()]*\))|\b(?P<name>[a-z_]+)=(?P<value>'[^']*'|[^\s,;:)`]*)")
STARTS_AGAIN = "no incomplete file is left; run the same command again"


@dataclass(frozen=True)
class Printing:
    """Options of every command."""

    json: Annotated[bool, setting("print one JSON object on stdout, for programs")] = False
    quiet: Annotated[bool, setting("print the result only, no progress, no warnings", short="q")] = False
    verbose: Annotated[bool, setting("print time, memory and tracebacks of errors", short="v")] = False


class Idle(NamedTuple):
    """A case in which settings of a command change nothing: they are refused if they are given."""

    where: Callable[..., str]  # of the command's records: why they change nothing; "" if the case is another one
    names: tuple[str, ...]


@dataclass(frozen=True)
class Command:
    """A command of a program."""

    run: Callable[..., int]
    examples: tuple[str, ...]
    after_interrupt: str  # what the same command does after Ctrl-C
    own: tuple[Setting, ...]  # in the order of the help: the commonest first
    idle: tuple[Idle, ...] = ()
    limits_threads: bool = False  # --threads is for the compiled engine

    @property
    def settings(self) -> tuple[Setting, ...]:
        """All settings, those of every command last."""
        return (*self.own, *settings_of(Printing))

    @property
    def options(self) -> dict[str, str]:
        """The options by the names of their arguments."""
        return {one.name: f"--{one.option}" for one in self.settings if not one.positional}

    def in_options(self, error: BaseException, text: str, others: Callable[[], Mapping[str, str]]) -> str:
        """Return the text of an error of the library with the options of this command in place of arguments.

        The library writes `ppp=` or `ppp=3.25` for an argument, and `force=True` for a flag; an `ArgumentError` begins
        with the name of its argument. `others` are the options of other commands, which a cure may name.
        """
        options = self.options
        if isinstance(error, ArgumentError):
            name = options.get(error.argument, error.argument)
            text = f"{name.replace('--', '--no-') if error.off else name}: {error.problem}"

        def option(found: re.Match[str]) -> str:
            name = options.get(found["name"]) or (None if found["call"] else others().get(found["name"]))
            if found["call"] is not None or name is None:
                return found[0]  # a call, or an argument of a function alone
            value = "" if found["value"] == "True" else found["value"]
            return f"{name} {value}".rstrip()

        return _ARGUMENT.sub(option, text)

    def arguments(self, values: Mapping[str, Any]) -> list[Any]:
        """Return what the function takes; `ArgumentError` for a setting that is given and cannot act."""
        found = [kind.made(values) for kind in _kinds(self.run)]
        for case in self.idle:
            why = case.where(*found)
            for name in case.names if why else ():
                value = values.get(name)
                if value is not None and value is not False:  # 0 is a given value
                    raise ArgumentError(name, f"{why}; leave it out")
        return found


def command(
    *examples: str, after_interrupt: str = STARTS_AGAIN, threads: str = "", idle: Sequence[Idle] = ()
) -> Callable[[Callable[..., int]], Callable[..., Any]]:
    """Return a decorator that declares a function of records as a command with these examples of its use.

    The help lists the options by their number of examples. With `threads`, the help of the option, the command has
    --threads. `idle` is the table of what cannot act together.
    """

    def declared(run: Callable[..., int]) -> Callable[..., Any]:
        own = [one for kind in _kinds(run) for one in kind.settings]
        if threads:
            (limit,) = settings_of(_threads_of(threads))
            own.append(limit)
        made = Command(run, examples, after_interrupt, commonest_first(own, examples), tuple(idle), bool(threads))

        def invoke(*_: Any, **__: Any) -> Command:
            return made

        parameters = sorted((parameter_of(one) for one in made.settings), key=lambda one: one.kind)
        invoke.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        invoke.__annotations__ = {}
        invoke.declared = made  # type: ignore[attr-defined]
        return invoke

    return declared


def commonest_first(settings: Iterable[Setting], examples: Iterable[str]) -> tuple[Setting, ...]:
    """Return the settings by how many examples use them, then by their first use; the others stay in order."""
    lines = [shlex.split(example, comments=True) for example in examples]
    words = [word for line in lines for word in line]

    def place(one: Setting) -> tuple[int, int]:
        names = () if one.positional else option_names(one)
        uses = sum(any(name in line for name in names) for line in lines)
        first = min((words.index(name) for name in names if name in words), default=len(words))
        return -uses, first

    return tuple(sorted(settings, key=place))


def _threads_of(words: str) -> Any:
    """Return a record with the setting --threads."""
    declared = Annotated[int | None, setting(words, unset="all cores")]
    return make_dataclass("Threads", [("threads", declared, None)])


@dataclass(frozen=True)
class _Kind:
    """What one parameter of a command's function holds."""

    record: Any
    several: bool = False  # one record for each combination of varied settings
    bare: bool = False  # the given settings alone: their defaults are chosen by others
    names: tuple[str, ...] = ()  # of the settings; empty: all of the record
    defaults: Mapping[str, Any] = field(default_factory=dict)  # of the command, in place of the record's

    @property
    def settings(self) -> list[Setting]:
        """The settings, below the heading that the record may state."""
        section = getattr(self.record, "SECTION", "")
        own = [one for one in settings_of(self.record) if not self.names or one.name in self.names]
        own = [replace(one, default=self.defaults.get(one.name, one.default)) for one in own]
        return [replace(one, section=one.section or section) for one in own]

    def made(self, values: Mapping[str, Any]) -> Any:
        """Return the value of the parameter."""
        if self.bare:
            return {one.name: values[one.name] for one in self.settings if one.name in values}
        values = dict(self.defaults) | dict(values)
        return records_of(self.record, values) if self.several else record_of(self.record, values)


def _kinds(run: Callable[..., int]) -> list[_Kind]:
    """Return what the parameters of a function hold.

    `Record` is one record, `tuple[Record, ...]` one for each combination of varied settings; `Annotated` with a
    dictionary states defaults of the command. `Annotated[dict[str, Any], Record, names]` holds those of the record's
    settings that are given; a dictionary after them states defaults, too.
    """
    hints = get_type_hints(run, include_extras=True)
    found = []
    for name in inspect.signature(run).parameters:
        hint = hints[name]
        notes: tuple[Any, ...] = ()
        if get_origin(hint) is Annotated:
            hint, *rest = get_args(hint)
            notes = tuple(rest)
        if get_origin(hint) is dict:
            names = tuple(note for note in notes[1:] if isinstance(note, str))
            stated = next((note for note in notes[1:] if isinstance(note, Mapping)), {})
            found.append(_Kind(notes[0], bare=True, names=names, defaults=stated))
            continue
        several = get_origin(hint) is tuple
        record = get_args(hint)[0] if several else hint
        defaults = notes[0] if notes else {}
        found.append(_Kind(record, several, defaults=defaults))
    return found
