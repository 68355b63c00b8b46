"""Prints completion scripts for bash, zsh and fish, made from the parsers.

bash completes commands, options and values (scenes, sensors, recipes, methods), else files; in a list, the value behind
the last comma. zsh runs the same script in its bash mode. fish has one line per option, with its help.
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from qsim.cli.console import command, options_of, output

SHELLS = ("bash", "zsh", "fish")
ValuesOf = Callable[[argparse.Action], list[str]]
Values = Mapping[str, Callable[[], Iterable[str]]]  # of an argument that takes other values too, by its name


def add_completion(sub: Any, parser: argparse.ArgumentParser, values: Values) -> None:
    """Add the command `completion` for all commands of `parser`, with `values` of arguments such as `--sensor`."""

    def _run_completion(args: argparse.Namespace) -> int:
        text = script(parser, args.shell, values)
        output(args, {"shell": args.shell, "script": text}, text)
        return 0

    prog = parser.prog
    own = command(
        sub,
        "completion",
        _run_completion,
        "Print a script that completes commands and options in your shell.",
        f"{prog} completion bash >> ~/.bashrc\n"
        f"{prog} completion zsh >> ~/.zshrc\n"
        f"{prog} completion fish > ~/.config/fish/completions/{prog}.fish",
    )
    own.add_argument("shell", choices=SHELLS, help="the shell")


def families() -> Iterable[str]:
    """Return the scene families."""
    from qsim.scenes import FAMILIES

    return FAMILIES


def recipes() -> Iterable[str]:
    """Return the names of the shipped recipes."""
    from qsim.scenes import RECIPES

    return RECIPES


def sensors() -> Iterable[str]:
    """Return the named sensors."""
    from qsim.sensor.devices import DEVICES

    return DEVICES


def script(parser: argparse.ArgumentParser, shell: str, values: Values) -> str:
    """Return the completion script of a program for one of SHELLS."""
    known = {name: list(listed()) for name, listed in values.items()}

    def values_of(action: argparse.Action) -> list[str]:
        names = [*action.option_strings, action.dest]
        return [str(v) for v in action.choices or next((known[name] for name in names if name in known), ())]

    return _fish(parser, values_of) if shell == "fish" else _bash(parser, shell, values_of)


def _words(parser: argparse.ArgumentParser, values_of: ValuesOf) -> list[str]:
    """Return the long options of a command and the values of its arguments."""
    options, positional, _ = options_of(parser)
    names = [action.option_strings[-1] for action in options]
    return [*names, *(value for action in positional for value in values_of(action))]


def _bash(parser: argparse.ArgumentParser, shell: str, values_of: ValuesOf) -> str:
    prog = parser.prog
    commands = options_of(parser).commands
    lines = ["autoload -U +X bashcompinit && bashcompinit"] if shell == "zsh" else []
    lines += [
        f"_{prog}_complete() {{",
        '    local word="${COMP_WORDS[COMP_CWORD]}" before="${COMP_WORDS[COMP_CWORD-1]}"',
    ]
    lines += [
        "    local words= head=",
        '    case "$word" in *,*) head="${word%,*},";; esac',
        "    COMPREPLY=()",
        '    case "${COMP_WORDS[1]} $before" in',
    ]
    for name, own in commands.items():
        for action in options_of(own).options:
            if values := values_of(action):
                patterns = "|".join(f'"{name} {option}"' for option in action.option_strings)
                listed = shlex.quote(" ".join(values))
                found = f'COMPREPLY=($(compgen -P "$head" -W {listed} -- "${{word##*,}}"))'
                files = "" if action.choices else '; [ ${#COMPREPLY[@]} -gt 0 ] || COMPREPLY=($(compgen -f -- "$word"))'
                lines.append(f"        {patterns}) {found}{files}; return;;")
    lines += ["    esac", '    case "${COMP_WORDS[1]}" in']
    lines += [
        f"        {name}) words={shlex.quote(' '.join(_words(own, values_of)))};;" for name, own in commands.items()
    ]
    lines += ["    esac", f"    [ $COMP_CWORD -gt 1 ] || words={shlex.quote(' '.join(commands))}"]
    lines += ['    COMPREPLY=($(compgen -W "$words" -- "$word"))']
    lines += ['    [ ${#COMPREPLY[@]} -gt 0 ] && [ -n "$word" ] || COMPREPLY+=($(compgen -f -- "$word"))']
    lines += ["}", f"complete -o filenames -F _{prog}_complete {prog}"]
    return "\n".join(lines)


def _fish(parser: argparse.ArgumentParser, values_of: ValuesOf) -> str:
    prog = parser.prog
    commands = options_of(parser).commands
    lines = []
    for name, own in commands.items():
        what = shlex.quote(own.description or "")
        lines.append(f"complete -c {prog} -n __fish_use_subcommand -f -a {name} -d {what}")
        seen = shlex.quote(f"__fish_seen_subcommand_from {name}")
        for action in options_of(own).positional:
            if values := values_of(action):
                lines.append(f"complete -c {prog} -n {seen} -a {shlex.quote(' '.join(values))}")
        for action in options_of(own).options:
            names = " ".join(f"-l {o[2:]}" if o.startswith("--") else f"-s {o[1:]}" for o in action.option_strings)
            taken = "" if action.nargs == 0 else " -r"
            if words := values_of(action):
                taken = f" {'-x' if action.choices else '-r'} -a {shlex.quote(' '.join(words))}"
            text = shlex.quote((action.help or "").replace("%%", "%"))
            lines.append(f"complete -c {prog} -n {seen} {names}{taken} -d {text}")
    return "\n".join(lines)
