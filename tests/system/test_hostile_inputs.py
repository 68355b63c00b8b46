"""Files of others under 1 GiB of addresses and 10 s: a command ends in its result, or in one sentence and exit code 2.

Every file that a command reads (support/inputs.py) is replaced by a pipe, a device, a folder, a file of a terabyte, a
link out of its folder or round in a circle, or its bytes are mutated. `-m slow` does it to all of them.
"""

from __future__ import annotations

import os
import random
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from damaged_bytes import mutate
from inputs import READS, REFUSED, write_inputs
from kill_server import KillServer

MEMORY = 1 << 30  # bytes of addresses beyond those of the interpreter
SECONDS = 10  # of the processor
ROUNDS = 40  # mutations of each command line; `QSIM_MUTATIONS` states another number


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the lines name."""
    folder = tmp_path_factory.mktemp("inputs")
    write_inputs(folder)
    return folder


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def endless(path: Path) -> None:
    path.unlink()
    path.symlink_to("/dev/zero")


def folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def circle(path: Path) -> None:
    path.unlink()
    path.symlink_to(path.name)


def terabyte(path: Path) -> None:
    os.truncate(path, 1 << 40)


def zeros(path: Path) -> None:
    path.write_bytes(b"")
    os.truncate(path, 1 << 40)


def empty(path: Path) -> None:
    path.write_bytes(b"")


def elsewhere(path: Path) -> None:
    """A link to the right content outside of the folder of the work."""
    top = next(parent for parent in path.parents if parent.name == "w")
    target = top.parent / f"of others {path.name}"
    shutil.move(path, target)
    path.symlink_to(target)


KINDS = (pipe, endless, folder, circle, terabyte, zeros, empty, elsewhere)
DATA = re.compile(r"(radiance|sharp|truth)/\d+\.exr|streams/\w+\.npy|r\.npy|zarr/.*zarr\.json")  # beside a description


class Attack:
    """Runs one command line in copies of what it reads."""

    def __init__(self, server: KillServer, work: Path, place: Path, line: str) -> None:
        self.server = server
        self.work = work
        self.place = place / "w"
        self.line = line
        self.renew()
        files = sorted(path.relative_to(self.place) for path in self.place.rglob("*") if path.is_file())
        kinds = {re.sub(r"\d+", "0", path.as_posix()): path for path in reversed(files)}  # frames are alike
        self.targets = sorted(path for path in kinds.values() if "locks" not in path.parts)

    def renew(self) -> None:
        """Make the files anew."""
        shutil.rmtree(self.place.parent, ignore_errors=True)
        self.place.mkdir(parents=True)
        for name in READS[self.line]:
            if (self.work / name).is_dir():
                shutil.copytree(self.work / name, self.place / name)
            else:
                shutil.copy(self.work / name, self.place / name)

    def run(self, what: str) -> tuple[int, str]:
        """Run the line; assert that it ends as it should."""
        code, _, told = self.server.run(self.place, self.line, memory=MEMORY, seconds=SECONDS)
        said = f"{self.line}: {what}: exit code {code}: {told[-600:]}"
        damaged = code == 1 and self.line.startswith("qsim check")
        assert code in (0, 2) or damaged, said
        assert "Traceback" not in told, said
        if code == 2:
            sentence = [line for line in told.splitlines() if line.startswith(("qsim:", "quiver:"))][-1:]
            assert sentence, said
            assert told.rstrip().endswith(sentence[0]), said
            assert "not enough memory" not in told, said
        return code, told

    def replaced(self, target: Path, kind: Callable[[Path], None]) -> None:
        """Replace a file, and run."""
        self.renew()
        kind(self.place / target)
        code, _ = self.run(f"{kind.__name__} in place of {target}")
        if kind is elsewhere and DATA.search(target.as_posix()) and code == 0 and target.name not in self.line:
            untouched = self.unread(target)
            assert untouched, f"{self.line}: {target} is a link out of its folder, and was read"

    def unread(self, target: Path) -> bool:
        """Whether the line does its work without a file."""
        self.renew()
        (self.place / target).unlink()
        return self.server.run(self.place, self.line)[0] == 0

    def mutated(self, chance: random.Random) -> None:
        """Mutate the bytes of one file, and run."""
        self.renew()
        target = chance.choice(self.targets)
        content = mutate((self.place / target).read_bytes(), chance)
        (self.place / target).write_bytes(content)
        try:
            self.run(f"mutated {target}")
        except AssertionError:
            kept = Path(os.environ.get("QSIM_CULPRITS", self.place.parent)) / f"culprit-{abs(hash(content))}"
            shutil.copytree(self.place, kept)
            raise


@pytest.mark.parametrize("kind", KINDS)
def test_no_file_of_a_clip_is_trusted(kind, server, tmp_path):
    """The quick form: one command, two files."""
    from clips import write_clip

    write_clip(tmp_path / "clip", frames=2, height=6, width=8)
    attack = Attack(server, tmp_path, tmp_path / "a", "qsim check clip")
    for target in ("clip/clip.json", "clip/radiance/000000.exr"):
        attack.replaced(Path(target), kind)


@pytest.mark.slow
@pytest.mark.parametrize("line", READS)
def test_no_file_that_a_command_reads_is_trusted(line, server, work, tmp_path):
    attack = Attack(server, work, tmp_path / "a", line)
    code, told = attack.run("untouched")
    assert code == 0 or line.startswith(REFUSED), told
    faults = []
    for target in attack.targets:
        for kind in KINDS:
            try:
                attack.replaced(target, kind)
            except AssertionError as error:
                faults.append(str(error))
    assert not faults, "\n".join(faults)


@pytest.mark.slow
@pytest.mark.parametrize("line", READS)
def test_mutated_files_end_in_a_result_or_a_sentence(line, server, work, tmp_path):
    attack = Attack(server, work, tmp_path / "a", line)
    chance = random.Random(f"{line} {os.environ.get('QSIM_SEED', '')}")
    faults = []
    for _ in range(int(os.environ.get("QSIM_MUTATIONS", ROUNDS))):
        try:
            attack.mutated(chance)
        except AssertionError as error:
            faults.append(str(error))
    assert not faults, "\n".join(faults)
