"""Makes options of settings: a record of settings becomes parameters of cyclopts, and their words become records.

    bits: Annotated[Bits | None, setting("bits per code")]  ->  --bits 3  ->  Record(bits=3)

Names, types, bounds and help are those of the declarations (qsim/settings.py). A word that does not fit is a
`ValueError` with what is expected; the command line prints it in one line with the name of the option.
"""

from __future__ import annotations

import glob
import inspect
import itertools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

import msgspec
from cyclopts import Parameter, Token

from qsim.checks import suggest
from qsim.records import bare_type, members_of, words_of
from qsim.settings import Setting, settings_of

LISTED = 60  # characters of choices that stand in the place of a value
EMPTY = "got an empty text; is a variable of the shell not set?"


# ---- Words to values


def value_of(words: Sequence[str], setting: Setting) -> Any:
    """Return the value of the words that a setting was given; `ValueError` if they do not fit."""
    if not all(words):
        raise ValueError(EMPTY)
    if setting.read is not None:
        return setting.read(words[0])
    items = items_of(setting.hint)
    if setting.varied:
        items = (setting.hint,)
    if items is None:
        return _item(words[0], setting.hint, setting)
    parts = list(words)
    if not (setting.several or setting.positional):
        parts = [part.strip() for part in words[0].split(",")]
    if not all(parts):
        raise ValueError(f"expected values with commas between them, got {words[0]!r}")
    hints = items if len(items) == len(parts) else itertools.repeat(items[0])
    found = tuple(_item(part, hint, setting) for part, hint in zip(parts, hints, strict=False))
    return found if setting.varied else _checked(found, setting.hint, words_of(setting.hint), " ".join(parts))


def items_of(hint: Any) -> tuple[Any, ...] | None:
    """Return the types of the items of a list or tuple; None for a type of single values."""
    for member in members_of(hint):
        if get_origin(bare_type(member)) in (tuple, list):
            return tuple(item for item in get_args(bare_type(member)) if item is not Ellipsis)
    return None


def _item(word: str, hint: Any, setting: Setting) -> Any:
    """Return one value of a word; `ValueError` with what is expected."""
    choices = choices_of(setting)
    if choices and word not in choices:
        raise ValueError(no_choice(word, choices))
    for member in members_of(hint):
        value = _as_kind(word, bare_type(member))
        if value is not None:
            return _checked(value, member, words_of(hint), word)
    raise ValueError(f"expected {words_of(hint)}, got {word!r}")


def no_choice(word: str, choices: Sequence[str]) -> str:
    """Return the sentence about a word that is none of the choices, with the one that was meant."""
    if not word:
        return EMPTY
    return f"expected one of {', '.join(choices)}, got {word!r}{suggest(word, choices)}"


def _as_kind(word: str, kind: Any) -> Any:
    """Return a word as a value of a kind; None if it is none of that kind."""
    if get_origin(kind) is Literal:
        kind = type(get_args(kind)[0])
    if kind is Path:
        return Path(word)
    if kind in (int, float):
        try:
            return kind(word)
        except ValueError:
            return None
    return word if kind is str else None


def _checked(value: Any, hint: Any, expected: str, word: str) -> Any:
    """Return a value that is within the bounds of its type."""
    try:
        return msgspec.convert(value, hint, dec_hook=lambda _, found: found)
    except msgspec.ValidationError:
        raise ValueError(f"expected {expected}, got {word!r}") from None


def choices_of(setting: Setting) -> tuple[str, ...]:
    """Return the only words that a setting takes; an empty tuple if there are others."""
    if setting.choices:
        return setting.choices
    hints = items_of(setting.hint) or (setting.hint,)
    members = [bare_type(member) for hint in hints for member in members_of(hint)]
    if any(get_origin(member) is not Literal for member in members):
        return ()
    return tuple(str(value) for member in members for value in get_args(member))


def is_flag(setting: Setting) -> bool:
    """Return whether a setting takes no value."""
    return all(bare_type(member) is bool for member in members_of(setting.hint))


# ---- Parameters of cyclopts


def option_names(setting: Setting) -> tuple[str, ...]:
    """Return the spellings of an option, the short one first; a flag that may be unset has an opposite."""
    short = (f"-{setting.short}",) if setting.short else ()
    opposite = (f"--no-{setting.option}",) if is_flag(setting) and setting.default is None else ()
    return (*short, f"--{setting.option}", *opposite)


def value_word(setting: Setting) -> str:
    """Return the word for the value of a setting, as the help and the manual print it; empty for a flag."""
    if is_flag(setting):
        return ""
    choices = choices_of(setting)
    name = setting.option.upper().replace("-", "_")
    listed = "{" + ",".join(choices) + "}"
    word = setting.shown or (listed if choices and len(listed) <= LISTED else name)
    if setting.positional and items_of(setting.hint) is not None:
        return f"{word} [{word} ...]" if setting.required else f"[{word} ...]"
    if setting.positional and not setting.required:
        return f"[{word}]"
    return f"{word} [{word} ...]" if setting.several == "following" and not setting.shown else word


def parameter_of(setting: Setting) -> inspect.Parameter:
    """Return the parameter of a function that cyclopts fills with a setting."""
    hint, given = _flag(setting) if is_flag(setting) else _valued(setting)
    kind = inspect.Parameter.POSITIONAL_ONLY if setting.positional else inspect.Parameter.KEYWORD_ONLY
    default = inspect.Parameter.empty if setting.required else None
    return inspect.Parameter(setting.name, kind, default=default, annotation=Annotated[hint, given])


def _flag(setting: Setting) -> tuple[Any, Parameter]:
    """Return type and parameter of a setting without a value."""
    names = [name for name in option_names(setting) if not name.startswith("--no-")]
    opposite = None if setting.default is None else ()
    return bool, Parameter(name=names, negative=opposite, help=setting.help, allow_repeating=opposite is not None)


def _valued(setting: Setting) -> tuple[Any, Parameter]:
    """Return type and parameter of a setting with values; the type tells shells to complete files."""
    items = items_of(setting.hint)
    grouped = items is not None and setting.several == "repeated" and items_of(items[0]) is not None
    many = bool(setting.several) or (setting.positional and items is not None)

    def converted(_: Any, tokens: Sequence[Token]) -> Any:
        if grouped and not all(token.value for token in tokens):
            raise ValueError(EMPTY)
        if grouped:  # FILE SECONDS of every occurrence
            return tuple(tuple(token.value for token in group) for group in _occurrences(tokens))
        words = [token.value for token in tokens]
        return value_of(words if many else words[-1:], setting)  # of an option that is repeated, the last counts

    choices = choices_of(setting)
    one_of_few = bool(choices) and not many and items is None and not setting.varied
    asked = setting.known is not None or (choices and not one_of_few)  # shells ask the program for names
    given = Parameter(
        name=setting.shown or setting.option.upper() if setting.positional else option_names(setting),
        converter=converted,
        help=setting.help,
        negative=(),
        allow_repeating=True,
        consume_multiple=(1, None) if grouped or setting.several == "following" else None,
        completer=_completer(setting, choices) if asked else None,
        choices=choices if one_of_few else None,
    )
    hint: Any = Path if _is_path(setting) else str
    return list[hint] if many else hint, given


def _occurrences(tokens: Sequence[Token]) -> Iterable[list[Token]]:
    """Yield the words of each occurrence of an option; cyclopts counts them from 0."""
    found: list[Token] = []
    for token in tokens:
        if token.index == 0 and found:
            yield found
            found = []
        found.append(token)
    if found:
        yield found


def _is_path(setting: Setting) -> bool:
    """Return whether the values of a setting are paths."""
    hints = items_of(setting.hint) or (setting.hint,)
    return any(bare_type(member) is Path for member in members_of(hints[0]))


def _completer(setting: Setting, choices: Sequence[str]) -> Any:
    """Return what offers names to a shell: in a list, behind its last comma; beside names that are known, files."""

    def offered(context: Any) -> list[str]:
        head, comma, word = context.incomplete.rpartition(",")
        names = [f"{head}{comma}{name}" for name in (setting.known or (lambda: choices))()]
        if setting.known is None:
            return names
        return names + [f"{head}{comma}{path}" for path in glob.glob(f"{glob.escape(word)}*")]

    return offered


def record_of(kind: Any, values: Mapping[str, Any]) -> Any:
    """Return a record with the settings that were given; the others have their defaults."""
    return kind(**{setting.name: values[setting.name] for setting in settings_of(kind) if setting.name in values})


def records_of(kind: Any, values: Mapping[str, Any]) -> tuple[Any, ...]:
    """Return one record for each combination of the values that varied settings were given."""
    varied = [setting.name for setting in settings_of(kind) if setting.varied and setting.name in values]
    combinations = itertools.product(*(values[name] for name in varied))
    return tuple(record_of(kind, dict(values) | dict(zip(varied, one, strict=True))) for one in combinations)
