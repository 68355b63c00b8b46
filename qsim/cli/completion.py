"""Prints completion scripts for bash, zsh and fish, made from the parsers.

bash completes commands, options and choices, else files. zsh runs the same script in its bash mode. fish has one line
per option, with its help.
"""

from __future__ import annotations

import argparse
import shlex
from typing import Any

from qsim.cli.console import command, options_of, output

SHELLS = ("bash", "zsh", "fish")


def add_completion(sub: Any, parser: argparse.ArgumentParser) -> None:
    """Add the command `completion` for all commands of `parser`."""

    def _run_completion(args: argparse.Namespace) -> int:
        text = script(parser, args.shell)
        output(args, {"shell": args.shell, "script": text}, text)
        return 0

    prog = parser.prog
    own = command(
        sub, "completion", _run_completion, "Print a script that completes commands and options in your shell.",
        f"{prog} completion bash >> ~/.bashrc\n"
        f"{prog} completion zsh >> ~/.zshrc\n"
        f"{prog} completion fish > ~/.config/fish/completions/{prog}.fish",
    )  # fmt: skip
    own.add_argument("shell", choices=SHELLS, help="the shell")


def script(parser: argparse.ArgumentParser, shell: str) -> str:
    """Return the completion script of a program for one of SHELLS."""
    return _fish(parser) if shell == "fish" else _bash(parser, shell)


def _words(parser: argparse.ArgumentParser) -> list[str]:
    """Return the long options of a command and the choices of its arguments."""
    options, positional, _ = options_of(parser)
    names = [action.option_strings[-1] for action in options]
    return [*names, *(str(choice) for action in positional for choice in action.choices or ())]


def _bash(parser: argparse.ArgumentParser, shell: str) -> str:
    prog, commands = parser.prog, options_of(parser).commands
    lines = ["autoload -U +X bashcompinit && bashcompinit"] if shell == "zsh" else []
    lines += [
        f"_{prog}_complete() {{",
        '    local word="${COMP_WORDS[COMP_CWORD]}" before="${COMP_WORDS[COMP_CWORD-1]}"',
    ]
    lines += ["    local words=", "    COMPREPLY=()", '    case "${COMP_WORDS[1]} $before" in']
    for name, own in commands.items():
        for action in options_of(own).options:
            if action.choices:
                patterns = "|".join(f'"{name} {option}"' for option in action.option_strings)
                values = shlex.quote(" ".join(str(choice) for choice in action.choices))
                lines.append(f'        {patterns}) COMPREPLY=($(compgen -W {values} -- "$word")); return;;')
    lines += ["    esac", '    case "${COMP_WORDS[1]}" in']
    lines += [f"        {name}) words={shlex.quote(' '.join(_words(own)))};;" for name, own in commands.items()]
    lines += ["    esac", f"    [ $COMP_CWORD -gt 1 ] || words={shlex.quote(' '.join(commands))}"]
    lines += ['    COMPREPLY=($(compgen -W "$words" -- "$word"))']
    lines += ['    [ ${#COMPREPLY[@]} -gt 0 ] && [ -n "$word" ] || COMPREPLY+=($(compgen -f -- "$word"))']
    lines += ["}", f"complete -o filenames -F _{prog}_complete {prog}"]
    return "\n".join(lines)


def _fish(parser: argparse.ArgumentParser) -> str:
    prog, commands = parser.prog, options_of(parser).commands
    lines = []
    for name, own in commands.items():
        what = shlex.quote(own.description or "")
        lines.append(f"complete -c {prog} -n __fish_use_subcommand -f -a {name} -d {what}")
        seen = shlex.quote(f"__fish_seen_subcommand_from {name}")
        for action in options_of(own).options:
            names = " ".join(f"-l {o[2:]}" if o.startswith("--") else f"-s {o[1:]}" for o in action.option_strings)
            values = "" if action.nargs == 0 else " -r"
            if action.choices:
                values = f" -x -a {shlex.quote(' '.join(str(choice) for choice in action.choices))}"
            text = shlex.quote((action.help or "").replace("%%", "%"))
            lines.append(f"complete -c {prog} -n {seen} {names}{values} -d {text}")
    return "\n".join(lines)
