"""Declares settings once: type, bounds, unit and a line of help of each, in the dataclass that holds them.

    bits: Annotated[Bits | None, setting("bits per code", unset="the sensor's own")] = None

Options, keys of recipes, Python arguments, stored descriptions and the tables of the manual are made from these fields
(`settings_of`). A record of settings checks itself by `records.settle` in its `__post_init__`.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import operator
from collections.abc import Callable, Iterable, Sequence
from dataclasses import MISSING, dataclass
from typing import Annotated, Any, Concatenate, Literal, ParamSpec, TypeVar, get_args, get_origin, get_type_hints

from msgspec import Meta

from qsim import records
from qsim.checks import shown, suggest

Several = Literal["", "following", "repeated"]

Fields = ParamSpec("Fields")
Record = TypeVar("Record")
Owner = TypeVar("Owner")
Answer = TypeVar("Answer")


def setting(  # noqa: PLR0913 (settings of a public function)
    words: str,
    *,
    unit: str = "",
    unset: str = "",
    option: str = "",
    short: str = "",
    shown: str = "",
    example: Any = None,
    varied: bool = False,
    recipe: bool = True,
    positional: bool = False,
    several: Several = "",
    read: Callable[[str], Any] | None = None,
    choices: Sequence[str] = (),
    known: Callable[[], Iterable[str]] | None = None,
    section: str = "",
) -> Meta:
    """Describe a field of a record of settings.

    `words` are one line of help without its default. `unit` is that of the value. `unset` says what None means.
    `option` is the name on the command line where it is not the field's, `short` its letter, and `shown` what stands
    for its value. `example` is a value for a reader of the manual, where the default is none. A `varied` setting may be
    a list on the command line and in a recipe: one result per value. `recipe` is False if recipes have no such key.

    The rest is of command lines. A `positional` setting has no option. A list is given with commas, or as `several`
    words that follow its option, or by a `repeated` option. `read` makes a value of a word that its type does not
    explain, such as `2GB`. A text may be limited to `choices`; `known` returns names that a shell completes, beside
    others that the setting takes. `section` is a heading of the help.
    """
    extra: dict[str, Any] = {"unit": unit, "unset": unset, "option": option, "short": short, "shown": shown}
    extra |= {"example": example, "varied": varied, "recipe": recipe, "positional": positional, "several": several}
    extra |= {"read": read, "choices": tuple(choices), "known": known, "section": section}
    return Meta(description=words, extra=extra)


@dataclass(frozen=True)
class Setting:
    """One field of a record of settings."""

    name: str
    hint: Any  # its type, with bounds
    default: Any  # MISSING if it must be given
    help: str
    unit: str
    unset: str  # what None means
    option: str  # name of the option, without dashes
    short: str
    shown: str
    example: Any
    varied: bool
    recipe: bool
    meta: Meta  # the declaration
    positional: bool = False
    several: Several = ""
    read: Callable[[str], Any] | None = None
    choices: tuple[str, ...] = ()
    known: Callable[[], Iterable[str]] | None = None
    section: str = ""

    @property
    def required(self) -> bool:
        return self.default is MISSING

    @property
    def expected(self) -> str:
        """What its type expects, in words."""
        return f"one of {', '.join(self.choices)}" if self.choices else records.words_of(self.hint)

    @property
    def default_words(self) -> str:
        """The default as the help and the manual print it; empty for a setting that must be given, or that is off."""
        if self.unset:
            return self.unset
        if self.required or self.default is None or self.default is False or self.default == ():
            return ""
        return f"{self.default:g}" if isinstance(self.default, float) else str(self.default)

    @property
    def help_with_default(self) -> str:
        """The line of help with its default, as in `bits per code (default: the sensor's own)`."""
        words = f"{self.help} [{self.unit}]" if self.unit else self.help
        if not self.default_words:
            return words
        mark = ": " if self.unset else " "
        return f"{words} (default{mark}{self.default_words})"


def settings_of(kind: Any) -> tuple[Setting, ...]:
    """Return the declared settings of a record, in order; its other fields are no settings."""
    if not any("setting(" in str(field.type) or not isinstance(field.type, str) for field in dataclasses.fields(kind)):
        return ()  # its types may be known to type checkers alone
    hints = records.hints_of(kind)
    found = []
    for field in dataclasses.fields(kind):
        hint = hints[field.name]
        declared = _declaration(hint)
        if declared is None:
            continue
        default = field.default if field.default_factory is MISSING else field.default_factory()
        extra: dict[str, Any] = dict(declared.extra or {})
        extra["option"] = extra["option"] or field.name.replace("_", "-")
        found.append(Setting(field.name, hint, default, declared.description or "", **extra, meta=declared))
    return tuple(found)


def settle(record: Any) -> None:
    """Bring the fields of a record of settings into the form of their types, and check choices; for `__post_init__`.

    `ValueError` with field, what is expected and what was given if a value does not fit.
    """
    records.settle(record)
    for one in settings_of(type(record)):
        value = getattr(record, one.name)
        if one.choices and value is not None and value not in one.choices:
            raise ValueError(
                f"{one.name}: expected {one.expected}, got {shown(value)}{suggest(str(value), one.choices)}"
            )


def given(record: Any) -> dict[str, Any]:
    """Return the settings of a record that differ from their defaults, as plain values: what is stored and compared.

    A setting that is off is never among them, so that a new one changes no digest.
    """
    names = {setting.name for setting in settings_of(type(record))}
    return {name: value for name, value in records.plain(record).items() if name in names}


def taking(
    kind: Callable[Fields, Record],
) -> Callable[[Callable[[Owner, Record], Answer]], Callable[Concatenate[Owner, Fields], Answer]]:
    """Let a method of one record be called with the fields of the record: `clip.sense("spad512s", ppp=3.25)`.

    The fields keep their types, so that a checker of types and an editor know them, and are named in the record alone.
    """

    def wrapped(method: Callable[[Owner, Record], Answer]) -> Callable[Concatenate[Owner, Fields], Answer]:
        @functools.wraps(method)
        def called(owner: Owner, /, *args: Fields.args, **fields: Fields.kwargs) -> Answer:
            return method(owner, kind(*args, **fields))

        owner = inspect.Parameter("self", inspect.Parameter.POSITIONAL_ONLY)
        hints = get_type_hints(kind)
        parameters = [each.replace(annotation=hints[name]) for name, each in inspect.signature(kind).parameters.items()]
        called.__signature__ = inspect.signature(method).replace(  # type: ignore[attr-defined]  # what `help` shows
            parameters=[owner, *parameters]
        )
        return called

    return wrapped


def section_of(name: str, kind: Any, own: Any, *, needed: tuple[str, ...] = ()) -> Any:
    """Return the record of a section of a recipe: the keys of the record `own`, and the settings of `kind`.

    Settings are optional, but those that are `needed`; None is one that is not given. A varied one may be a list.
    Objects that no file holds are left out of its types.
    """
    required: list[Any] = []
    optional: list[Any] = []
    taken = set(records.hints_of(own))
    for declared in settings_of(kind):
        if not declared.recipe or declared.name in taken:
            continue
        hint = _of_files(declared.hint)
        if declared.varied:
            hint = hint | Annotated[tuple[hint, ...], Meta(min_length=1)]  # type: ignore[valid-type]
        if declared.name in needed:
            required.append((declared.name, Annotated[hint, declared.meta]))
        else:
            optional.append((declared.name, Annotated[hint | None, declared.meta], None))
    made = dataclasses.make_dataclass(name, [*required, *optional], bases=(own,), frozen=True, kw_only=True)
    made.__module__ = own.__module__
    made.__doc__ = own.__doc__
    return made


def _of_files(hint: Any) -> Any:
    """Return the alternatives of a type that files hold."""
    found = [member for member in records.members_of(hint) if records.is_of_files(member)]
    return functools.reduce(operator.or_, found)


def _declaration(hint: Any) -> Meta | None:
    """Return the outermost description of a type that `setting` made; None if there is none."""
    if get_origin(hint) is not Annotated:
        return None
    for note in get_args(hint)[1:]:
        if isinstance(note, Meta) and "varied" in (note.extra or {}):  # other descriptions are for the JSON Schema
            return note
    return None
