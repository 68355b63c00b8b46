"""Runs commands: one line for each error, progress bars, and what an interruption leaves.

Exit codes: 0 success, 1 done with findings (a damaged file, a failed job), 2 wrong input, 130 interrupted. `--verbose`
or `QSIM_DEBUG=1` shows the traceback of an error.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from qsim.cli.command import STARTS_AGAIN, Command, Printing
from qsim.cli.setting_options import record_of
from qsim.cli.signals import ending
from qsim.cli.usage import Program, UsageError
from qsim.files import FULL, Progress, wording
from qsim.process import peak_memory
from qsim.scratch import sweep
from qsim.terminal import in_one_line, printable, tolerant_output

SHOWN_AFTER = 2.0  # s, before a progress bar appears
PILOT = "pilot and compilation of kernels"  # before the first frame of a renderer
RESUMES = "the same command resumes where it stopped"
WITHOUT_FORCE = "the same command without --force resumes where it stopped"
MAKES_AGAIN = "finished files stay; the same command with --force makes all of them again"

# Optional packages by the extra of this project that lists them, and what needs them.
OPTIONAL: dict[str, tuple[tuple[str, ...], str]] = {
    "networks": (
        ("torch", "safetensors", "tensorboard"),
        "quiver: restoring, training, evaluating",
    ),
    "video": (("av", "cv2"), "video files: qsim convert, qsim preview; frames between frames: qsim convert --rate"),
    "formats": (("zarr", "h5py"), "Zarr and HDF5 files: qsim convert, qsim calibrate"),
    "publish": (("pyarrow", "fsspec"), "qsim publish: Parquet, and addresses as s3://"),
    "s3": (("s3fs",), "published sets at s3://"),
    "tiff": (("imagecodecs",), "compressed TIFF (LZW, CCITT, zstd) and 12-bit TIFF: qsim convert"),
    "tcspc": (("ptufile", "sdtfile"), "photon counts of PTU and SDT files: qsim convert"),
    "cluster": (("distributed",), "qsim generate --cluster"),
    "denoise": (("pyoidn",), "fewer samples at the same error: qsim render, qsim generate"),
}
INSTALLED_AS = {"cv2": "opencv-python-headless"}  # package -> its name in the index, where it is another
_PACKAGES = {package for packages, _ in OPTIONAL.values() for package in packages}

quiet: ContextVar[bool] = ContextVar("quiet", default=False)  # of the running command


@dataclass
class Running:
    """The command that runs: how it prints, and what an interruption leaves."""

    program: Program | None = None
    command: Command | None = None
    printing: Printing = field(default_factory=Printing)
    threads: int | None = None
    target: Path | None = None  # the file or folder that it makes
    after_interrupt: str = STARTS_AGAIN  # what the same command does then
    given: frozenset[str] = frozenset()  # the settings of the command line

    @property
    def silent(self) -> bool:
        """Whether nothing is printed but the result."""
        return self.printing.quiet or self.printing.json


_running: ContextVar[Running | None] = ContextVar("running", default=None)


def running() -> Running:
    """Return the command that runs."""
    return _running.get() or Running()


def run(program: Program, argv: Sequence[str] | None) -> int:
    """Read and run a command line; return its exit code. Wrong input becomes one line on stderr and 2, Ctrl-C 130,
    as do termination (SIGTERM) and a terminal that closes (SIGHUP).

    With --json a failure is also an object on stdout: {"error": its line, "exit_code": 2}. Without words, print help.
    Streams that cannot be written do not end the work. A result that is lost on stdout changes exit code 0 to 1, but
    not if its reader has ended, as in `| head`.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    with tolerant_output() as (out, _), ending():
        code = _run(program, words)
        out.flush()
        lost = out.failure
        if code == 0 and lost is not None and not isinstance(lost, BrokenPipeError):
            return failed(
                f"{program.name}: standard output: {wording(lost)}; the work is done, its report is lost", 1, False
            )
        return code


def _run(program: Program, words: Sequence[str]) -> int:
    """Read and run a command line as `run`; print on `sys.stdout` and `sys.stderr`."""
    if not words:
        print(program.help())
        return 0
    try:
        command, values = program.read(words)
    except UsageError as error:
        return failed(str(error), 2, "--json" in words)
    if command is None:
        return 0
    printing = record_of(Printing, values)
    outputs = [values.get(setting.name) for setting in command.settings if setting.option == "output"]
    state = Running(
        program=program,
        command=command,
        printing=printing,
        threads=values.get("threads"),
        target=next((Path(output) for output in outputs if output), None),
        after_interrupt=command.after_interrupt,
        given=frozenset(values),
    )
    token = _running.set(state)
    try:
        return _answered(program, command, values, state)
    finally:
        _running.reset(token)


def _answered(program: Program, command: Command, values: Mapping[str, Any], state: Running) -> int:
    """Run a command; return its exit code, and print its failure as a line."""
    started = time.perf_counter()
    try:
        if state.target is not None:
            sweep(state.target.parent)
            sweep(state.target)
        with _warnings_as_lines(program.name), program.guard(command), _limited(command, state.threads):
            return int(command.run(*command.arguments(values)))
    except (ValueError, OSError, MemoryError, ImportError) as error:
        if isinstance(error, ImportError) and _is_fault(error):
            raise
        if os.environ.get("QSIM_DEBUG") or state.printing.verbose:
            print(printable(traceback.format_exc()), end="", file=sys.stderr)
        return failed(
            f"{program.name}: {command.in_options(error, one_line(error), program.options)}", 2, state.printing.json
        )
    except RuntimeError as error:
        if not str(error).startswith("Symlink loop"):  # of pathlib, for a link that leads to itself
            raise
        return failed(f"{program.name}: {one_line(error)}; name the file itself", 2, state.printing.json)
    except KeyboardInterrupt:
        print(file=sys.stderr)  # after the ^C of the terminal
        return failed(f"{program.name}: interrupted; {_then(state)}", 130, state.printing.json)
    finally:
        if state.printing.verbose:
            spent = time.perf_counter() - started
            memory = peak_memory() / 2**30
            print(f"{program.name}: {spent:.1f} s, at most {memory:.2f} GiB of memory", file=sys.stderr)


def _is_fault(error: ImportError) -> bool:
    """Return whether an import failed by a fault of ours, not by a package that is missing or cannot be loaded."""
    package = (error.name or "").split(".")[0]
    if isinstance(error, ModuleNotFoundError):
        return package not in _PACKAGES
    return package in ("qsim", "quiver")


def _then(state: Running) -> str:
    """Return what the same command does after an interruption: before anything is stored, it cannot resume."""
    place = state.target or Path(".")
    stored = any(Path(f"{place}{end}").exists() for end in ("", ".part"))
    return state.after_interrupt if stored else STARTS_AGAIN


@contextlib.contextmanager
def _limited(command: Command, threads: int | None) -> Iterator[None]:
    """Hold the compiled engine to --threads inside the block, also in worker processes that are started in it."""
    if threads is None or not command.limits_threads:
        yield
        return
    cores = os.cpu_count() or 1
    if not 1 <= threads <= cores:
        raise ValueError(f"--threads {threads}: this machine has {cores} cores; give 1 to {cores}")
    before = os.environ.get("QSIM_THREADS")
    try:
        _limit(str(threads))
        yield
    finally:  # later commands of this process have all threads
        _limit(before or str(cores))
        if before is None:
            del os.environ["QSIM_THREADS"]


def _limit(threads: str) -> None:
    """Set the threads of the compiled engine, if it is loaded, and of processes that are started later."""
    os.environ["QSIM_THREADS"] = threads
    if "drjit" in sys.modules:
        from qsim.backend import limit_threads

        limit_threads()


def failed(text: str, code: int, as_json: bool) -> int:
    """Print why a command failed, with --json also as an object on stdout; return its exit code."""
    print(in_one_line(text), file=sys.stderr)
    if as_json:
        print(json.dumps({"error": text, "exit_code": code}, sort_keys=True))
    return code


@contextlib.contextmanager
def _warnings_as_lines(prog: str) -> Iterator[None]:
    """Print each warning as one line on stderr, without its place in the source; none with --quiet."""

    def show(message: Warning | str, *_: object, **__: object) -> None:
        note(f"{prog}: warning: {in_options(' '.join(str(message).split()))}")

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


def in_options(text: str) -> str:
    """Return a text of the library with the options of the running command in place of arguments."""
    state = running()
    if state.program is None or state.command is None:
        return text
    return state.command.in_options(ValueError(text), text, state.program.options)


def note(text: str) -> None:
    """Print a line on stderr, unless the command runs with --quiet."""
    if not running().printing.quiet:
        print(in_one_line(text), file=sys.stderr)


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
        name = INSTALLED_AS.get(package, package)
        return f"needs the package {name}, which is not installed: pip install {name}{extra}"
    if isinstance(error, ImportError):
        return f"a library cannot be loaded ({wording(error)}); is there enough memory, and is it installed in full?"
    if isinstance(error, MemoryError):
        return f"not enough memory ({' '.join(str(error).split()) or 'none is left'}); try fewer or smaller frames"
    return wording(error)


def output(found: Mapping[str, object], text: str | Sequence[str]) -> None:
    """Print the result of the command: JSON with --json, else text."""
    if running().printing.json:
        print(json.dumps(found, sort_keys=True))
    else:
        print(printable(text if isinstance(text, str) else "\n".join(text)))


def refuse_existing(path: Path, force: bool) -> None:
    """Raise an `OSError` with the cure, before the work, if a file cannot be written or exists without `force`."""
    if path.is_dir():
        raise FileExistsError(f"{path}: is a folder; name a file with -o")
    if path.exists() and not force:
        raise FileExistsError(f"{path}: exists; name another, or replace it with --force")
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
    silent = running().printing.quiet
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
