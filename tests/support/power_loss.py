"""Models a power cut: which files a disk may hold after it, given what a command did and what it synced.

    recorder = Recorder(folder)      in the process of the command: `tree` before each operation, `sync` at each fsync
    for state in crashes(steps):     every distinct folder that POSIX allows after a cut at any point

The content of a file is kept if the file was synced after it was written. A name (made, renamed, removed) is kept if
its folder was synced after it. Of everything else each part may be kept or lost on its own: a content is the old one,
the new one, or zeros in its length. A rename is kept or lost as a whole.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import random
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

MOST = 12  # operations of which all combinations are tried; of more, a sample of as many combinations

Tree = dict[str, tuple[int, bytes | None, int]]  # path -> (inode, content, time of its change); None for a folder
Step = tuple[str, Tree | int]  # ("tree", files) or ("sync", inode)
State = dict[str, tuple[bytes, int] | None]  # path -> (content, time of its change); None for a folder


class Recorder:
    """Notes the files of a folder between the operations of this process, and what it syncs."""

    def __init__(self, folder: str) -> None:
        self.folder = folder
        self.steps: list[Step] = []
        self._busy = False
        self._lock = threading.RLock()
        self._known: dict[bytes, bytes] = {}
        self._fsync = os.fsync

    def start(self) -> None:
        """Note the files now, and every fsync from now on."""
        self.tree()
        os.fsync = self.sync  # type: ignore[assignment]

    def tree(self) -> None:
        """Note the files; other threads wait with their operations."""
        with self._lock:
            if self._busy:  # its own reading
                return
            self._busy = True
            try:
                self.steps.append(("tree", self._files()))
            finally:
                self._busy = False

    def _files(self) -> Tree:
        """Return the files of the folder, again if an operation of another thread had begun before."""
        while True:
            with contextlib.suppress(FileNotFoundError):
                return self._found()

    def _found(self) -> Tree:
        found: Tree = {}
        for place, folders, names in os.walk(self.folder):
            for name in folders:
                path = os.path.join(place, name)
                found[os.path.relpath(path, self.folder)] = (os.lstat(path).st_ino, None, 0)
            for name in names:
                path = os.path.join(place, name)
                content = Path(path).read_bytes()
                status = os.lstat(path)
                kept = self._known.setdefault(content, content)
                found[os.path.relpath(path, self.folder)] = (status.st_ino, kept, status.st_mtime_ns)
        return found

    def sync(self, file: int) -> None:
        """Sync a file or a folder, and note it."""
        descriptor = file if isinstance(file, int) else file.fileno()
        self._fsync(descriptor)
        self.tree()
        self.steps.append(("sync", os.fstat(descriptor).st_ino))


# ---- What may be left


@dataclass(eq=False)
class Change:
    """An operation on names: what each (folder, name) became, a file or (None) nothing."""

    names: dict[tuple[int, str], int | None]
    kept: bool = False  # its folder was synced


@dataclass
class File:
    """What is known of the content of a file."""

    folder: bool
    now: bytes = b""
    synced: bytes = b""
    changed: int = 0  # ns

    @property
    def may_be(self) -> list[bytes]:
        """The contents that it may have after a cut."""
        if self.now == self.synced:
            return [self.now]
        return list(dict.fromkeys((self.now, self.synced, bytes(len(self.now)))))


@dataclass
class Disk:
    """The names and contents so far, by numbers that are not used twice, as those of inodes are."""

    files: list[File] = field(default_factory=lambda: [File(True)])  # the first is the folder itself
    changes: list[Change] = field(default_factory=list)
    names: dict[tuple[int, str], int] = field(default_factory=dict)
    numbers: dict[int, int] = field(default_factory=dict)  # inode -> number

    def follow(self, tree: Tree, root: int) -> None:
        """Take over the files of a later moment."""
        numbers = {root: 0}
        names = {}
        for path in sorted(tree):  # a folder before its files
            inode, content, changed = tree[path]
            if inode not in numbers:
                known = self.numbers.get(inode)
                if known is None or self.files[known].folder != (content is None):
                    known = len(self.files)
                    self.files.append(File(content is None))
                numbers[inode] = known
            parent = numbers[tree[os.path.dirname(path)][0]] if os.path.dirname(path) else 0
            names[parent, os.path.basename(path)] = numbers[inode]
            self.files[numbers[inode]].now = content or b""
            self.files[numbers[inode]].changed = changed
        self._note(names)
        self.names = names
        self.numbers = numbers

    def _note(self, names: Mapping[tuple[int, str], int]) -> None:
        """Note how names changed: renamed, then made or replaced, then removed."""
        gone = {key: file for key, file in self.names.items() if key not in names}
        new = {key: file for key, file in names.items() if self.names.get(key) != file}
        for key, file in new.items():
            source = next((old for old, there in gone.items() if there == file), None)
            if source is not None:
                del gone[source]
            self.changes.append(Change({key: file} if source is None else {source: None, key: file}))
        self.changes += [Change({key: None}) for key in gone]

    def sync(self, inode: int) -> None:
        """Keep the content of a file, or the names in a folder."""
        number = self.numbers.get(inode)
        if number is None:  # of a folder outside, or of a file that has no name
            return
        self.files[number].synced = self.files[number].now
        for change in self.changes:
            change.kept |= self.files[number].folder and any(folder == number for folder, _ in change.names)

    def keep_all(self) -> None:
        """Keep everything: what was there before the command."""
        for file in self.files:
            file.synced = file.now
        for change in self.changes:
            change.kept = True

    def states(self, chance: random.Random, most: int) -> Iterator[State]:
        """Yield what may be left now; of more than `most` combinations a sample, with those that lose one part."""
        pending = [change for change in self.changes if not change.kept]
        unsure = [file for file in self.files if not file.folder and len(file.may_be) > 1]
        choices: list[list[bool] | list[bytes]] = [[True, False] for _ in pending]
        choices += [file.may_be for file in unsure]
        total = 1
        for choice in choices:
            total *= len(choice)
        if total <= most:
            combinations: Iterator[tuple[bool | bytes, ...]] = itertools.product(*choices)
        else:
            combinations = iter(_sample(choices, chance, most))
        for chosen in combinations:
            lost = {id(change) for change, kept in zip(pending, chosen, strict=False) if not kept}
            contents = {id(file): content for file, content in zip(unsure, chosen[len(pending) :], strict=True)}
            yield self._left(lost, contents)

    def _left(self, lost: set[int], contents: Mapping[int, bool | bytes]) -> State:
        names: dict[int, dict[str, int]] = {}
        for change in self.changes:
            if id(change) in lost:
                continue
            for (folder, name), file in change.names.items():
                if file is None:
                    names.get(folder, {}).pop(name, None)
                else:
                    names.setdefault(folder, {})[name] = file
        found: State = {}
        waiting = [(0, "")]
        while waiting:
            number, place = waiting.pop()
            for name, inner in names.get(number, {}).items():
                path = os.path.join(place, name)
                file = self.files[inner]
                if file.folder:
                    found[path] = None
                    waiting.append((inner, path))
                else:
                    content = contents.get(id(file), file.now)
                    assert isinstance(content, bytes)
                    found[path] = content, file.changed
        return found


def _sample(
    choices: list[list[bool] | list[bytes]], chance: random.Random, most: int
) -> Iterator[tuple[bool | bytes, ...]]:
    """Yield combinations: all first choices, each other choice alone against both grounds, then some by chance."""
    for ground in (0, 1):
        yield tuple(choice[ground] for choice in choices)
        for place, choice in enumerate(choices):
            for other in choice:
                yield tuple(other if n == place else each[ground] for n, each in enumerate(choices))
    for _ in range(most):
        yield tuple(chance.choice(choice) for choice in choices)


def crashes(steps: list[Step], root: int, chance: random.Random) -> Iterator[State]:
    """Yield every distinct state of the folder (inode `root`) after a cut anywhere in the steps."""
    disk = Disk()
    seen: set[frozenset[tuple[str, bytes | None]]] = set()
    for number, (kind, what) in enumerate(steps):
        if kind == "tree":
            assert isinstance(what, dict)
            disk.follow(what, root)
        else:
            assert isinstance(what, int)
            disk.sync(what)
        if number == 0:
            disk.keep_all()
        for state in disk.states(chance, 1 << MOST):
            key = frozenset((path, found and found[0]) for path, found in state.items())
            if key not in seen:
                seen.add(key)
                yield state


def put(state: State, folder: Path) -> None:
    """Make a folder of these files."""
    folder.mkdir(parents=True)
    for path in sorted(state):
        found = state[path]
        if found is None:
            (folder / path).mkdir()
        else:
            (folder / path).write_bytes(found[0])
            os.utime(folder / path, ns=(found[1], found[1]))
