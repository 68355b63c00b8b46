"""Runs commands: a parser that suggests options, progress bars, and errors of one line.

Exit codes: 0 success, 1 done with findings (a damaged file, a failed job), 2 wrong input, 130 interrupted. `--verbose`
or `QSIM_DEBUG=1` shows the traceback of an error.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import json
import os
import re
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from qsim.checks import suggest
from qsim.cli.options import refuse_empty
from qsim.files import FULL, Progress, wording
from qsim.process import peak_memory
from qsim.scratch import sweep
from qsim.terminal import printable, tolerant_output

SHOWN_AFTER = 2.0  # s, before a progress bar appears
PILOT = "pilot and compilation of kernels"  # before the first frame of a renderer
RESUMES = "the same command resumes where it stopped"
STARTS_AGAIN = "no incomplete file is left; run the same command again"
WITHOUT_FORCE = "the same command without --force resumes where it stopped"
MAKES_AGAIN = "finished files stay; the same command with --force makes all of them again"

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

# Optional packages by the extra of this project that lists them, and what needs them.
OPTIONAL: dict[str, tuple[tuple[str, ...], str]] = {
    "networks": (
        ("torch", "safetensors", "tensorboard"),
        "quiver: restoring, training, evaluating",
    ),
    "video": (("av",), "video files: qsim convert, qsim preview"),
    "formats": (("zarr", "h5py"), "Zarr and HDF5 files: qsim convert, qsim calibrate"),
    "tiff": (("imagecodecs",), "compressed TIFF (LZW, CCITT, zstd) and 12-bit TIFF: qsim convert"),
    "tcspc": (("ptufile", "sdtfile"), "photon counts of PTU and SDT files: qsim convert"),
    "cluster": (("distributed",), "qsim generate --cluster"),
    "denoise": (("pyoidn",), "fewer samples at the same error: qsim render, qsim generate"),
}
_PACKAGES = {package for packages, _ in OPTIONAL.values() for package in packages}

quiet: ContextVar[bool] = ContextVar("quiet", default=False)  # of the running command


class Parser(argparse.ArgumentParser):
    """argparse with one-line errors that suggest the option or command that was meant."""

    def __init__(self, prog: str | None = None, description: str | None = None, epilog: str | None = None) -> None:
        style = argparse.RawDescriptionHelpFormatter
        super().__init__(prog=prog, description=description, epilog=epilog, formatter_class=style, allow_abbrev=False)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        words = list(sys.argv[1:] if args is None else args)
        self._refuse_unknown(words)  # before argparse reports a missing argument whose name is misspelt
        found, extra = super().parse_known_args(words, namespace)
        if extra:
            self.error(f"unexpected argument {extra[0]}")
        return found, extra

    def _refuse_unknown(self, words: list[str]) -> None:
        options, _, commands = options_of(self)
        known = [name for action in options for name in action.option_strings]
        for word in words:
            if word == "--" or (commands and not word.startswith("-")):
                return  # the rest are values, or the words of a command
            option = word.split("=")[0]
            short = re.match(r"-[A-Za-z]", word)
            if (short and word[:2] not in known) or (word.startswith("--") and option not in known):
                meant = _ALSO_CALLED.get(option, "")
                self.error(f"unknown option {option}{suggest(meant if meant in known else option, known)}")

    def error(self, message: str) -> NoReturn:
        choice = re.search(r"invalid choice: '?([^']*?)'? \(choose from (.*)\)", message)
        number = re.match(r"argument (.*): invalid (int|float) value: (.*)", message)
        if choice:
            known = [word.strip(" '") for word in choice[2].split(",")]
            what = "command" if "COMMAND" in message else message.split(":")[0]
            message = f"unknown {what} '{choice[1]}'{suggest(choice[1], known)}; there are: {', '.join(known)}"
        elif number:
            kind = "a whole number, as in 3" if number[2] == "int" else "a number, as in 3.25 or 20e-6"
            message = f"argument {number[1]}: expected {kind}, got {number[3]}"
        raise UsageError(f"{self.prog}: {message}; see {self.prog} --help")


class UsageError(SystemExit):
    """Wrong options or arguments; its text is printed by `run`."""

    def __init__(self, text: str) -> None:
        super().__init__(2)
        self.text = text


class Arguments(NamedTuple):
    """The arguments of a parser."""

    options: list[argparse.Action]
    positional: list[argparse.Action]
    commands: dict[str, argparse.ArgumentParser]


def options_of(parser: argparse.ArgumentParser) -> Arguments:
    """Return the arguments of a parser; argparse has no public way to list them."""
    actions = parser._actions
    commands = {
        name: below
        for action in actions
        if isinstance(action, argparse._SubParsersAction)
        for name, below in action.choices.items()
    }
    options = [action for action in actions if action.option_strings]
    return Arguments(options, [action for action in actions if not action.option_strings], commands)


def command(
    sub: Any,
    name: str,
    run: Callable[[argparse.Namespace], int],
    what: str,
    example: str,
    after_interrupt: str = STARTS_AGAIN,
    *,
    threads: str | None = None,
) -> argparse.ArgumentParser:
    """Add a command with its example and the options of all commands; `run(args)` returns the exit code.

    With `threads`, the help of the option, the command has --threads.
    """
    epilog = "example:\n" + "".join(f"  {line}\n" for line in example.split("\n"))
    parser: argparse.ArgumentParser = sub.add_parser(name, help=what, description=what, epilog=epilog)
    refuse_empty(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object on stdout, for programs")
    loudness = parser.add_mutually_exclusive_group()
    loudness.add_argument("-q", "--quiet", action="store_true", help="print the result only, no progress, no warnings")
    loudness.add_argument("-v", "--verbose", action="store_true", help="print time, memory and tracebacks of errors")
    if threads is not None:
        run = _with_threads(run)
        parser.add_argument("--threads", type=int, help=f"{threads} (default: all cores)")
    parser.set_defaults(run=run, after_interrupt=after_interrupt)
    return parser


def _with_threads(run: Callable[[argparse.Namespace], int]) -> Callable[[argparse.Namespace], int]:
    """Return the command with --threads threads of the compiled engine, also in its worker processes."""

    def limited(args: argparse.Namespace) -> int:
        if args.threads is None:
            return run(args)
        cores = os.cpu_count() or 1
        if not 1 <= args.threads <= cores:
            raise ValueError(f"--threads {args.threads}: this machine has {cores} cores; give 1 to {cores}")
        before = os.environ.get("QSIM_THREADS")
        try:
            _limit(str(args.threads))
            return run(args)
        finally:  # later commands of this process have all threads
            _limit(before or str(cores))
            if before is None:
                del os.environ["QSIM_THREADS"]

    return limited


def _limit(threads: str) -> None:
    """Set the threads of the compiled engine, if it is loaded, and of processes that are started later."""
    os.environ["QSIM_THREADS"] = threads
    if "drjit" in sys.modules:
        from qsim.backend import limit_threads

        limit_threads()


def run(parser: argparse.ArgumentParser, argv: Sequence[str] | None) -> int:
    """Parse and run a command; return its exit code. Wrong input becomes one line on stderr and 2, Ctrl-C 130.

    With --json a failure is also an object on stdout: {"error": its line, "exit_code": 2}. Without words, print help.
    Streams that cannot be written do not end the work. A result that is lost on stdout changes exit code 0 to 1, but
    not if its reader has ended, as in `| head`.
    """
    with tolerant_output() as (out, _):
        code = _run(parser, argv)
        out.flush()
        lost = out.failure
        if code == 0 and lost is not None and not isinstance(lost, BrokenPipeError):
            return failed(
                f"{parser.prog}: standard output: {wording(lost)}; the work is done, its report is lost", 1, False
            )
        return code


def _run(parser: argparse.ArgumentParser, argv: Sequence[str] | None) -> int:
    """Parse and run a command as `run`; print on `sys.stdout` and `sys.stderr`."""
    given = list(sys.argv[1:] if argv is None else argv)
    if not given:
        parser.print_help()
        return 0
    try:
        args = parser.parse_args(given)
    except UsageError as stop:
        return failed(stop.text, 2, "--json" in given)
    except SystemExit as stop:
        return int(stop.code or 0)
    token = quiet.set(args.quiet)
    started = time.perf_counter()
    try:
        _sweep(getattr(args, "output", None))
        with _warnings_as_lines(parser.prog):
            return int(args.run(args))
    except (ValueError, OSError, MemoryError, ModuleNotFoundError) as error:
        if isinstance(error, ModuleNotFoundError) and (error.name or "").split(".")[0] not in _PACKAGES:
            raise
        if os.environ.get("QSIM_DEBUG") or args.verbose:
            print(printable(traceback.format_exc()), end="", file=sys.stderr)
        return failed(f"{parser.prog}: {one_line(error)}", 2, args.json)
    except KeyboardInterrupt:
        return failed(f"\n{parser.prog}: interrupted; {_then(args)}", 130, args.json)
    finally:
        quiet.reset(token)
        if args.verbose:
            spent = time.perf_counter() - started
            memory = peak_memory() / 2**30
            print(f"{parser.prog}: {spent:.1f} s, at most {memory:.2f} GiB of memory", file=sys.stderr)


def _sweep(named: str | os.PathLike[str] | None) -> None:
    """Delete what killed writers left beside and in the output of a command."""
    if named is not None:
        sweep(Path(named).parent)
        sweep(Path(named))


def _then(args: argparse.Namespace) -> str:
    """Return what the same command does after an interruption: before anything is stored, it cannot resume."""
    stored = any(Path(f"{getattr(args, 'output', '.')}{end}").exists() for end in ("", ".part"))
    return str(args.after_interrupt) if stored else STARTS_AGAIN


def failed(text: str, code: int, as_json: bool) -> int:
    """Print why a command failed, with --json also as an object on stdout; return its exit code."""
    print(printable(text), file=sys.stderr)
    if as_json:
        print(json.dumps({"error": text.strip(), "exit_code": code}, sort_keys=True))
    return code


@contextlib.contextmanager
def _warnings_as_lines(prog: str) -> Iterator[None]:
    """Print each warning as one line on stderr, without its place in the source; none with --quiet."""

    def show(message: Warning | str, *_: object, **__: object) -> None:
        note(f"{prog}: warning: {' '.join(str(message).split())}")

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


def note(text: str) -> None:
    """Print a line on stderr, unless the command runs with --quiet."""
    if not quiet.get():
        print(printable(text), file=sys.stderr)


def one_line(error: BaseException) -> str:
    """Return an error in one line; an `OSError` of the system names its file and the reason."""
    if isinstance(error, OSError) and error.filename and error.errno in (errno.ENOTDIR, errno.EEXIST):
        path = Path(os.fsdecode(error.filename))
        for in_the_way in filter(Path.is_file, (path, *path.parents)):
            return f"{in_the_way}: is a file where a folder is needed; name another with -o"
    if isinstance(error, OSError) and error.errno in FULL and error.strerror:
        return f"{wording(error)}; no incomplete file is left; make space and run the same command again"
    if isinstance(error, ModuleNotFoundError):
        package = (error.name or "").split(".")[0]
        extra = next((f"; the extra {name} has it" for name, (all_of, _) in OPTIONAL.items() if package in all_of), "")
        return f"needs the package {package}, which is not installed: pip install {package}{extra}"
    if isinstance(error, MemoryError):
        return f"not enough memory ({' '.join(str(error).split()) or 'none is left'}); try fewer or smaller frames"
    return wording(error)


def output(args: argparse.Namespace, found: dict[str, Any], text: str | Sequence[str]) -> None:
    """Print the result of a command: JSON with --json, else text."""
    if args.json:
        print(json.dumps(found, sort_keys=True))
    else:
        print(printable(text if isinstance(text, str) else "\n".join(text)))


def refuse_idle(args: argparse.Namespace, where: str, names: Sequence[str]) -> None:
    """Raise `ValueError` if an option without effect is given; the defaults of `names` are None or False."""
    for name in names:
        value = getattr(args, name)
        if value is not None and value is not False:  # 0 is a given value
            raise ValueError(f"{where}: --{name.replace('_', '-')} changes nothing here; leave it out")


def refuse_existing(path: Path, force: bool) -> None:
    """Raise an `OSError` with the cure, before the work, if a file cannot be written or exists without `force`."""
    if path.is_dir():
        raise FileExistsError(f"{path}: is a folder; name a file with -o")
    if path.exists() and not force:
        raise FileExistsError(f"{path}: exists; name another with -o, or use --force to replace it")
    folder = next(parent for parent in path.parents if parent.exists())
    if not folder.is_dir():
        raise NotADirectoryError(f"{folder}: is a file where a folder is needed; name another with -o")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise PermissionError(f"{path}: no permission to write into {folder}; name another with -o")


@contextlib.contextmanager
def bar(label: str, unit: str = "frame", first: str = "") -> Iterator[Progress]:
    """Show a progress bar on stderr after `SHOWN_AFTER`; the block calls it with (done, total).

    `first` names the work before the first unit is done; it is shown after that time, too.
    """
    from tqdm import tqdm

    label = printable(label)
    interval = 0.2 if sys.stderr.isatty() else 10.0
    silent = quiet.get()
    options = {"unit": unit, "delay": SHOWN_AFTER, "mininterval": interval, "dynamic_ncols": True, "disable": silent}
    with tqdm(desc=label, file=sys.stderr, **options) as shown:

        def begin() -> None:
            shown.last_print_t = time.time()  # it is shown, so its line must end
            shown.set_description_str(f"{label}, {first}")

        waiting = threading.Timer(SHOWN_AFTER, begin)
        waiting.daemon = True

        def update(done: int, total: int) -> None:
            if done and first:
                waiting.cancel()
                shown.set_description_str(label, refresh=False)
            shown.total = total
            shown.update(done - shown.n)

        if first and not silent:
            waiting.start()
        try:
            yield update
        except BaseException:
            shown.leave = False  # the reason of the failure is the last line
            raise
        finally:
            waiting.cancel()
