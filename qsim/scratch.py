"""Keeps what a writer has not finished in a folder that is provably its own, beside the output.

    .qsim-TOKEN/record.json   the token again; locked while the writer lives. Once all new files are complete, also
                              their outputs, which a killed writer had still to name
    .qsim-TOKEN/0, 1          new files or folders, which are renamed to their output when they are complete
    .qsim-TOKEN/old           a folder that was replaced, until it is deleted

TOKEN is 64 random bits and 64 bits of their SHA-256, and the folder is made exclusively, so no file or link of anybody
lies under its names. Of a writer that was killed, `sweep` gives complete files their names and deletes the folder: only
if its token is such a pair, its lock is free, this user owns it, and it holds nothing but these names. A power cut may
have lost the record or its content; then nothing gets a name. Whatever else looks like it stays.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType

from qsim import limits

try:
    import fcntl
except ModuleNotFoundError:
    raise ImportError("qsim runs on Linux and macOS: it locks files by fcntl, which this system lacks") from None

PREFIX = ".qsim-"
RECORD = "record.json"
OLD = "old"
_NEW = re.compile(r"[0-9]{1,3}")
_FOLDER = re.compile(r"\.qsim-([0-9a-f]{32})")
_EXCLUSIVE = os.O_CREAT | os.O_EXCL | os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC


class Scratch:
    """A new folder beside an output; with everything in it, it is deleted at the end of the block."""

    def __init__(self, output: Path) -> None:
        self._parent = output.parent
        self._lock: int | None = None

    def __enter__(self) -> Scratch:
        while not self._made():  # another process swept the folder before it had its record
            pass
        return self

    def _made(self) -> bool:
        """Make the folder and its record, locked; return False if they were taken for those of a killed writer."""
        token = _token()
        self.folder = self._parent / f"{PREFIX}{token}"
        os.mkdir(self.folder, 0o700)
        try:
            lock = os.open(self.folder / RECORD, _EXCLUSIVE, 0o600)
        except FileNotFoundError:
            return False
        except BaseException:
            self.folder.rmdir()
            raise
        try:
            made = self._record(lock, token)
        except BaseException:
            os.close(lock)
            _delete(self.folder)
            raise
        if made:
            self._lock = lock
        else:
            os.close(lock)
        return made

    def _record(self, lock: int, token: str) -> bool:
        """Lock and write the record; return False if another process has taken it."""
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:  # a file system without locks, where nothing is swept
            pass
        os.write(lock, json.dumps({"software": "qsim", "token": token}).encode())
        return (self.folder / RECORD).exists()

    def new(self, number: int = 0) -> Path:
        """Return the name of a new file or folder, which the caller makes, completes and renames."""
        return self.folder / str(number)

    def name(self, *outputs: tuple[Path, Path]) -> None:
        """Rename complete and synced new files, (file, output) each, all of them even if this process is killed.

        The outputs lie beside the folder, and all but the first describe those before them: old ones are deleted first,
        so that a description which exists describes what is there.
        """
        with _alone(self._parent, len(outputs) > 1):
            self._name(outputs)

    def _name(self, outputs: Sequence[tuple[Path, Path]]) -> None:
        moves = [(str(new.relative_to(self.folder)), output.name, _state(output)) for new, output in outputs]
        if self._lock is not None and len(moves) > 1:  # one file is whole or absent without a record
            record = {"software": "qsim", "token": self.folder.name.removeprefix(PREFIX), "moves": moves}
            os.pwrite(self._lock, json.dumps(record).encode(), 0)
            os.fsync(self._lock)
            _sync(self.folder)  # a power cut after the first rename leaves the record and the other files
            _sync(self._parent)
        waiting = [(new, name) for new, name, _ in moves]
        try:
            _finish(self.folder, waiting)
        except BaseException:  # Ctrl-C between two renames: complete files get all their names
            with contextlib.suppress(OSError):
                _finish(self.folder, waiting)
            raise

    @property
    def old(self) -> Path:
        """Return the name to which a folder that is replaced is moved."""
        return self.folder / OLD

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with contextlib.suppress(OSError):
            _delete(self.folder)
        if self._lock is not None:
            os.close(self._lock)


@contextlib.contextmanager
def _alone(folder: Path, several: bool) -> Iterator[None]:
    """Let one process at a time name several files in a folder: those of two writers never mix.

    A file system without locks keeps them apart no more than two renames do.
    """
    if not several:
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        with contextlib.suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _token() -> str:
    """Return a new token."""
    chance = secrets.token_hex(8)
    return chance + _proof(chance)


def _proof(chance: str) -> str:
    """Return the second half of a token: no other program, and no person, makes it by chance."""
    return hashlib.sha256(b"a scratch folder of qsim: " + chance.encode()).hexdigest()[:16]


def sweep(folder: Path) -> None:
    """Delete what killed writers left directly in a folder; a folder that cannot be read or written is left alone."""
    with contextlib.suppress(OSError), os.scandir(folder) as items:
        names = [item.name for item in items if _FOLDER.fullmatch(item.name) and item.is_dir(follow_symlinks=False)]
        for name in names:
            with contextlib.suppress(OSError):
                _sweep(folder / name)


def is_scratch(path: Path) -> bool:
    """Return whether a path lies in a folder whose name is that of a `Scratch`."""
    return any(_FOLDER.fullmatch(part) for part in path.parts)


def _sweep(folder: Path) -> None:
    if os.stat(folder).st_uid != os.geteuid():
        return
    with contextlib.suppress(OSError):
        folder.rmdir()  # an empty one
        return
    try:
        lock = os.open(folder / RECORD, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:  # lost by a power cut: a writer that lives has one before it makes anything else
        if _is_proven(folder):
            _delete(folder)
        return
    try:
        if not stat.S_ISREG(os.fstat(lock).st_mode):
            return
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # an error while its writer lives
        record = os.read(lock, limits.RECORD)
        if _is_proven(folder):
            with _alone(folder.parent, several=True):
                _finish(folder, _moves_of(folder, record))
            _delete(folder)
    finally:
        os.close(lock)


def _is_proven(folder: Path) -> bool:
    """Return whether a folder has the name of a writer's, and holds only what a writer makes."""
    token = folder.name.removeprefix(PREFIX)
    ours = token[16:] == _proof(token[:16])
    return ours and all(name in (RECORD, OLD) or _NEW.fullmatch(name) for name in os.listdir(folder))


def _state(output: Path) -> list[int]:
    """Return what tells a file from another of its name; empty if there is none."""
    try:
        found = os.lstat(output)
    except FileNotFoundError:
        return []
    return [found.st_size, found.st_mtime_ns]


def _moves_of(folder: Path, record: bytes) -> list[tuple[str, str]]:
    """Return (file in the folder, name of its output) of what a killed writer had completed and not named.

    Empty if an output is another file than it was then, somebody else's, and if one of the new files was lost.
    """
    try:
        stated = json.loads(record)
    except ValueError:  # a power cut lost its content
        return []
    ours = isinstance(stated, dict) and f"{PREFIX}{stated.get('token')}" == folder.name
    found = stated.get("moves", []) if ours else []
    left = [(new, name, state) for new, name, state in found if (folder / new).is_file()]
    gone = [(name, state) for new, name, state in found if not (folder / new).is_file()]
    if any(_state(folder.parent / name) == state for name, state in gone):
        return []  # a power cut kept the record, and not the names of all new files
    named = all(Path(name).name == name and ".." not in Path(new).parts for new, name, _ in left)
    same = all(_state(folder.parent / name) in ([], state) for _, name, state in left)
    return [(new, name) for new, name, _ in left] if named and same else []


def _finish(folder: Path, moves: Sequence[tuple[str, str]]) -> None:
    """Name the files that have no name yet; after a power cut, too, a description that exists describes its file."""
    left = [(folder / new, folder.parent / name) for new, name in moves if (folder / new).is_file()]
    for _, output in left[1:]:
        output.unlink(missing_ok=True)
    if len(left) > 1:
        _sync(folder.parent)
    for new, output in left:
        os.replace(new, output)
        if len(moves) > 1:
            _sync(folder.parent)


def _sync(folder: Path) -> None:
    """Sync the names in a folder."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _delete(folder: Path) -> None:
    """Delete the contents, then the record, which proves that they are ours, then the folder."""
    for name in sorted(os.listdir(folder), key=lambda name: name == RECORD):
        item = folder / name
        if item.is_dir() and not item.is_symlink():
            shutil.rmtree(item)
        else:
            os.unlink(item)
    folder.rmdir()
