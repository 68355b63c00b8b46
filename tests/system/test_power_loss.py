"""Every command that writes, and a power cut at any point: outputs are whole or absent, or the next command mends them.

What the disk may hold then is modelled (support/power_loss.py). The same command is run there: it ends in the right
result, or names --force and has left whole outputs. `-m slow` runs it in many states of every command.
"""

from __future__ import annotations

import pickle
import random
import re
import shutil

import pytest
from power_loss import State, crashes, put
from writing_commands import LINES, Search

RUNS = 60  # states of each command line in which it is run; `-m slow` alone


class Cut:
    """A command line, and what a power cut leaves of it."""

    def __init__(self, search: Search, force: bool) -> None:
        self.search = search
        self.line = search.line
        place = search.place()
        if force:
            code, _, told = search.server.run(place, self.line)
            assert code == 0, told
            self.line += " --force"
        trace = place.parent / "trace"
        code, _, told = search.server.run(place, self.line, trace=trace)
        assert code == 0, told
        steps = pickle.loads(trace.read_bytes())
        self.chance = random.Random(self.line)
        self.states = list(crashes(steps, place.stat().st_ino, self.chance))
        self.before = {path for path, (_, content, _) in steps[0][1].items() if content is not None}

    def check(self, state: State, number: int) -> None:
        """Run the command in a state, and compare."""
        search = self.search
        place = search.folder / f"cut {number}" / "w"
        put(state, place)
        whole = self._whole(state)
        code, _, told = search.server.run(place, self.line)
        line = self.line
        if code == 2 and "--force" not in line:
            assert "--force" in told, self._said(state, told)
            assert whole, self._said(state, "its outputs are not whole, and it refuses to go on")
            line += " --force"
            code, _, told = search.server.run(place, line)
        assert code == 0, self._said(state, told)
        for folder in _without_proof(state):
            shutil.rmtree(place / folder, ignore_errors=True)
        search.compare(place, self._said(state, ""))
        shutil.rmtree(place.parent)

    def _whole(self, state: State) -> bool:
        """Whether every output under its name is the right one."""
        right = self.search.right
        return all(found is not None and found[0] == right[path] for path, found in state.items() if path in right)

    def _said(self, state: State, told: str) -> str:
        shown = {path: None if found is None else len(found[0]) for path, found in state.items()}
        new = {path: size for path, size in shown.items() if path not in self.before}
        return f"{self.line}: cut with {new}: {told[-300:]}"


def _without_proof(state: State) -> list[str]:
    """Return scratch folders whose record was lost: nobody may delete them."""
    folders = [path for path in state if re.fullmatch(r"(.*/)?\.qsim-[0-9a-f]{32}", path)]
    records = {folder: state.get(f"{folder}/record.json") for folder in folders}
    return [folder for folder, found in records.items() if found is None or b"token" not in found[0]]


def faults_of(cut: Cut, states: list[State]) -> list[str]:
    """Check the states; return what went wrong, each kind once."""
    faults: dict[str, str] = {}
    for number, state in enumerate(states):
        try:
            cut.check(state, number)
        except AssertionError as error:
            text = str(error).partition("\nassert")[0]
            faults.setdefault(re.sub(r"[0-9a-f]{32}|\d+", "", text), text)
    return list(faults.values())


@pytest.mark.parametrize("force", [False, True])
def test_a_stream_survives_a_power_cut(force, server, work, tmp_path):
    """The quick form: one command, two states."""
    search = Search(server, work, tmp_path, "qsim convert codes.npy c --layout codes --bits 3 --frame-rate 9")
    cut = Cut(search, force)
    assert len(cut.states) > 20
    assert not faults_of(cut, cut.chance.sample(cut.states, 2))


@pytest.mark.slow
@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("line", LINES)
def test_every_command_survives_a_power_cut(line, force, server, work, tmp_path):
    search = Search(server, work, tmp_path, line)
    cut = Cut(search, force)
    chosen = cut.chance.sample(cut.states, min(RUNS, len(cut.states)))
    faults = faults_of(cut, chosen)
    assert not faults, "\n".join(faults)
