"""What every command shares: a parser that suggests, a bar that waits two seconds, and errors of one line.

Exit codes: 0 well, 1 done but something is wrong with what was found (a damaged file, a failed job), 2 the user's
mistake, 130 interrupted. `QSIM_DEBUG=1` shows the traceback of a mistake.
"""

from __future__ import annotations

import argparse
import contextlib
import difflib
import json
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

from qsim import stream


class Parser(argparse.ArgumentParser):
    """argparse with one-line errors that suggest the option or command that was meant."""

    def __init__(self, prog: str | None = None, description: str | None = None, epilog: str | None = None) -> None:
        style = argparse.RawDescriptionHelpFormatter
        super().__init__(prog=prog, description=description, epilog=epilog, formatter_class=style, allow_abbrev=False)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        found, extra = super().parse_known_args(args, namespace)
        if extra:
            word = extra[0].split("=")[0]
            known = [option for action in self._actions for option in action.option_strings]
            what = "unknown option" if word.startswith("-") else "unexpected argument"
            self.error(f"{what} {word}{suggest(word, known)}")
        return found, extra

    def error(self, message: str) -> NoReturn:
        choice = re.search(r"invalid choice: '([^']*)' \(choose from (.*)\)", message)
        if choice:
            known = [word.strip(" '") for word in choice[2].split(",")]
            what = "command" if "COMMAND" in message else message.split(":")[0]
            message = f"unknown {what} '{choice[1]}'{suggest(choice[1], known)}; there are: {', '.join(known)}"
        print(f"{self.prog}: {message}; see {self.prog} --help", file=sys.stderr)
        raise SystemExit(2)


def suggest(word: str, known: Sequence[str]) -> str:
    """`; did you mean '...'?`, or nothing if no known word is close."""
    close = difflib.get_close_matches(word, known, n=1)
    return f"; did you mean '{close[0]}'?" if close else ""


def command(
    sub: Any, name: str, run: Callable[[argparse.Namespace], int], what: str, example: str
) -> argparse.ArgumentParser:
    """A command's parser with its example and --json; `run(args)` does it and returns the exit code."""
    parser: argparse.ArgumentParser = sub.add_parser(
        name, help=what, description=what, epilog="example:\n" + "".join(f"  {line}\n" for line in example.split("\n"))
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object on stdout, for programs")
    parser.set_defaults(run=run)
    return parser


def run(parser: argparse.ArgumentParser, argv: Sequence[str] | None) -> int:
    """Parse and do a command; mistakes become one line on stderr and exit code 2, Ctrl-C becomes 130."""
    try:
        args = parser.parse_args(argv)
    except SystemExit as stop:
        return int(stop.code or 0)
    try:
        return int(args.run(args))
    except (ValueError, OSError) as error:
        if isinstance(error, BrokenPipeError):  # the reader of our output has gone, as in `| head`
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0
        if os.environ.get("QSIM_DEBUG"):
            raise
        print(f"{parser.prog}: {one_line(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"\n{parser.prog}: interrupted; the same command goes on where it stopped", file=sys.stderr)
        return 130


def one_line(error: BaseException) -> str:
    """The message of an error in one line; an `OSError` of the system names its file and the reason."""
    if isinstance(error, OSError) and error.strerror and error.filename:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split()) or type(error).__name__


def output(args: argparse.Namespace, found: dict[str, Any], text: str | Sequence[str]) -> None:
    """The result of a command: JSON where asked for, else text."""
    if args.json:
        print(json.dumps(found, sort_keys=True))
    else:
        print(text if isinstance(text, str) else "\n".join(text))


def refuse_existing(path: Path, force: bool) -> None:
    """`FileExistsError` with the cure if a file that is to be written is there already and `force` is not set."""
    if path.is_dir():
        raise FileExistsError(f"{path}: is a folder; name a file with -o")
    if path.exists() and not force:
        raise FileExistsError(f"{path}: exists; name another with -o, or use --force to replace it")


@contextlib.contextmanager
def bar(label: str, unit: str = "frame") -> Iterator[stream.Progress]:
    """A progress bar with rate and time left on stderr, shown after two seconds; call it with (done, total)."""
    from tqdm import tqdm

    interval = 0.2 if sys.stderr.isatty() else 10.0
    with tqdm(desc=label, unit=unit, delay=2, mininterval=interval, dynamic_ncols=True, file=sys.stderr) as shown:

        def update(done: int, total: int) -> None:
            shown.total = total
            shown.update(done - shown.n)

        yield update
