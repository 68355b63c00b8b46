"""Renders the data set of a recipe in another process while a network learns from what is finished of it.

    with Rendering("scenes/starter.toml", "out/starter", "val") as rendering:
        rendering.wait()         # for the first clip to train on, and the first to validate on
        ...                      # train; `look` states what is finished, `complete` waits for all to validate on

The first clip of the split `train` is rendered first, then all to validate on, then one clip of each section of the
recipe in turn, so that a network sees all kinds early. The process ends with this one; the same command resumes.
On a machine with several GPUs it has the last one, on a CPU half of the cores unless QSIM_THREADS says otherwise.
"""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Self

from qsim.dataset import generation, recipe
from qsim.dataset.clip_list import ClipList
from qsim.dataset.dataset import Dataset
from qsim.dataset.job import Job
from qsim.dataset.jobs import Jobs
from quiver.data.growing import Schedule, planned
from quiver.device import environment_beside_training

RENDERER = (sys.executable, "-m", "quiver.data.rendering")
PAUSE = 0.5  # s, between looks at what is finished
TRAIN = "train"


class Rendering:
    """A data set that is rendered meanwhile."""

    def __init__(
        self,
        source: str,
        folder: Path,
        validation: str,
        *,
        should_stop: Callable[[], bool] = lambda: False,
        note: Callable[[str], None] = lambda line: None,
    ) -> None:
        """Read the recipe; `ValueError` if it has no clips in the split `train` or in that to validate on, and for a
        folder with clips of another recipe.
        """
        self.source = source
        self.recipe = recipe.load(source)
        self.folder = folder
        self.validation = validation
        self.should_stop = should_stop
        self.note = note
        splits = {part[0].split for part in self.recipe.jobs.by_section()}
        for split in (TRAIN, validation):
            if split not in splits:
                raise ValueError(
                    f"{source}: has no clips in split '{split}', on which a run that renders meanwhile depends; add a "
                    "section to the recipe, or render it first with `qsim generate`"
                )
        if (folder / "dataset.json").is_file() and Dataset.open(folder).info.scenes != self.recipe.jobs.listing.series:
            raise ValueError(
                f"{folder}: is the data set of another recipe than {source}; remove it, or choose another folder for "
                "the run, beside which the data set is rendered"
            )
        self._process: subprocess.Popen[bytes] | None = None
        self._told = False

    def __enter__(self) -> Self:
        words = [*RENDERER, self.source, str(self.folder), self.validation]
        self._process = subprocess.Popen(
            words,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            env=environment_beside_training(),
            start_new_session=True,
        )
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._process is not None
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
            self.note(f"{self.folder}: rendering stopped with the training; `qsim generate` goes on")
        self._process.wait()

    def wait(self) -> None:
        """Wait until a clip to train on and one to validate on are finished; `ValueError` if none will be."""
        for split in (TRAIN, self.validation):
            self._until(split, 1)

    def complete(self) -> None:
        """Wait until all clips to validate on are finished; `ValueError` if one cannot be rendered."""
        self._until(self.validation, sum(len(part) for part in self.data.parts(self.validation)))

    def _until(self, split: str, count: int) -> None:
        """Wait until so many clips of a split are finished; `ValueError` if the renderer ended before."""
        while True:
            ended = self._ended()
            begun = (self.folder / "dataset.json").is_file()
            done = len(self.data.indices(split)) if begun else 0
            if done >= count:
                return
            if ended:
                raise ValueError(
                    f"{self.folder}: {done} of {count} clips of split '{split}' could be rendered that the run waits "
                    f"for; `qsim generate` of {self.source} says why"
                )
            if self.should_stop():
                raise KeyboardInterrupt
            time.sleep(PAUSE)

    def _ended(self) -> bool:
        """Return whether the renderer has ended; a failure is told once."""
        assert self._process is not None
        code = self._process.poll()
        if code and not self._told:
            self._told = True
            self.note(f"{self.folder}: rendering ended with exit code {code}; the run goes on with what is finished")
        return code is not None

    @property
    def data(self) -> Dataset:
        """The data set; there is one after `wait`."""
        return Dataset.open(self.folder)

    def clips(self) -> tuple[ClipList, ClipList]:
        """Return the clips to train and to validate on, finished or not."""
        return planned(self.data, TRAIN), planned(self.data, self.validation)

    def schedule(self, path: Path) -> Schedule:
        """Return the schedule of a run."""
        return Schedule(path, self.data, TRAIN)

    def look(self, schedule: Schedule, sample: int) -> None:
        """Let what is finished now be drawn from this sample on."""
        self._ended()
        schedule.look(sample)


def is_recipe(data: str) -> bool:
    """Return whether a source of training data is a recipe to render."""
    return data.endswith(".toml")


def folder_of(source: str, run: Path) -> Path:
    """Return the folder of a recipe's data set: beside that of the run, named by the recipe."""
    return run.parent / recipe.load(source).name


def mixed(jobs: Jobs, validation: str) -> Iterator[Job]:
    """Yield the first job to train on, all to validate on, and one of each other section in turn."""
    sections = jobs.by_section()
    training = [part for part in sections if part[0].split != validation]
    first = next((part[0] for part in training if part[0].split == TRAIN), None)
    if first is not None:
        yield first
    for part in sections:
        if part[0].split == validation:
            yield from part
    for turn in itertools.count():
        left = [part for part in training if turn < len(part)]
        if not left:
            return
        yield from (part[turn] for part in left if part[turn] != first)


def _end_with(parent: int) -> None:
    """End this process when its parent has ended; its workers end with it."""
    while os.getppid() == parent:
        time.sleep(PAUSE)
    os._exit(1)


def main(words: list[str]) -> int:
    """Render the recipe of the first word into the folder of the second; the third names the split to validate on."""
    source, folder, validation = words
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    try:
        summary = generation.generate(
            recipe.load(source), folder, generation.Options(workers=1), order=lambda jobs: mixed(jobs, validation)
        )
    except (ValueError, OSError) as error:
        print(f"quiver: {error}", file=sys.stderr)
        return 2
    for name, why in sorted(summary.failed.items()):
        print(f"quiver: {name} could not be rendered: {why}", file=sys.stderr)
    return 1 if summary.failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
