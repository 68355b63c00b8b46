"""Text streams whose failures do not end the work: a full device, a closed descriptor, a pipe without a reader.

Progress and messages never decide a result. What cannot be written is dropped; a command reports a lost output at its
end.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import sys
from collections.abc import Iterator
from typing import Any, TextIO, cast

_CONTROLS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")


def printable(text: str) -> str:
    """Return a text whose control characters are escapes, so that no name or value of a file moves the terminal.

    Line ends and tabs stay; marks that turn the direction of writing do not.
    """
    return _CONTROLS.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def in_one_line(text: str) -> str:
    """Return a text as `printable`, with line ends and tabs as escapes, too: a name that holds them."""
    return printable(text).replace("\n", "\\n").replace("\t", "\\t")


class Tolerant:
    """A text stream that drops what cannot be written; None stands for a stream that the process lacks."""

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream
        self.failure: OSError | ValueError | None = None  # the first one

    def write(self, text: str) -> int:
        """Write a text; characters that the encoding of the stream lacks are written as escapes."""
        if self._stream is not None:
            try:
                self._write(self._stream, text)
            except (OSError, ValueError) as error:  # ValueError: the stream is closed
                self._drop(error)
        return len(text)

    @staticmethod
    def _write(stream: TextIO, text: str) -> None:
        try:
            stream.write(text)
        except UnicodeEncodeError:
            encoding = stream.encoding or "ascii"
            stream.write(text.encode(encoding, "backslashreplace").decode(encoding))

    def flush(self) -> None:
        """Write what is kept in memory."""
        if self._stream is not None:
            try:
                self._stream.flush()
            except (OSError, ValueError) as error:
                self._drop(error)

    def isatty(self) -> bool:
        """Return whether this is an interactive terminal."""
        try:
            return self._stream is not None and self._stream.isatty()
        except ValueError:
            return False

    def fileno(self) -> int:
        """Return the descriptor; `OSError` (`io.UnsupportedOperation`) without one."""
        if self._stream is None:
            raise io.UnsupportedOperation("fileno")
        return self._stream.fileno()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _drop(self, error: OSError | ValueError) -> None:
        """Note a failure; empty the stream's memory, which the interpreter would try to write again at its end."""
        self.failure = self.failure or error
        assert self._stream is not None
        with contextlib.suppress(OSError, ValueError):
            descriptor = self._stream.fileno()
            kept = os.dup(descriptor)
            nowhere = os.open(os.devnull, os.O_WRONLY)
            try:
                os.dup2(nowhere, descriptor)
                self._stream.flush()
            finally:
                os.dup2(kept, descriptor)
                os.close(kept)
                os.close(nowhere)


def is_lost(stream: object) -> bool:
    """Return whether something could not be written to a stream of `tolerant_output`."""
    return isinstance(stream, Tolerant) and stream.failure is not None


@contextlib.contextmanager
def tolerant_output() -> Iterator[tuple[Tolerant, Tolerant]]:
    """Let the block print to standard output and standard error, which it receives, without a failure."""
    open_descriptors()
    out = Tolerant(sys.stdout)
    err = Tolerant(sys.stderr)
    with contextlib.redirect_stdout(cast(TextIO, out)), contextlib.redirect_stderr(cast(TextIO, err)):
        yield out, err
        out.flush()
        err.flush()


def open_descriptors() -> None:
    """Open the null device as each of the descriptors 0 to 2 that is closed.

    Else a data file would take the number, and what a library prints there would be written into it.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # takes the lowest number that is free
