"""Commands in the conditions of a service: each ends in its right result, or in one sentence and an exit code.

No standard error, a full log, no home and no name of the user, a home to read, a narrow mask, a clock that jumps, a
terminal that closes, termination, a pause. `-m slow` tries each on every command that writes.
"""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from kill_server import KillServer
from service import CONDITIONS
from writing_commands import LINES, Search

QUICK = "qsim convert codes.npy c --layout codes --bits 3 --frame-rate 9"


@pytest.fixture(scope="module")
def search(work: Path, tmp_path_factory: pytest.TempPathFactory) -> Search:
    """What the quick form runs."""
    return Search(KillServer.shared(), work, tmp_path_factory.mktemp("search"), QUICK)


def check_condition(search: Search, condition: str) -> None:
    """Run a line in a condition, and compare with a quiet run."""
    place = search.place()
    before = set(place.rglob("*"))
    code, _, told = search.server.run(place, search.line, condition=condition)
    said = f"{search.line}: {condition}: {code}: {told}"
    assert code == 0, said
    assert "Traceback" not in told, said
    search.compare(place, said)
    if condition == "narrow_mask":
        made = [path for path in set(place.rglob("*")) - before if path.is_file()]
        assert not any(path.stat().st_mode & 0o077 for path in made), said


def check_event(search: Search, event: str, step: int) -> None:
    """Run a line that meets an event at an operation, and again if it was ended."""
    place = search.place()
    code, _, told = search.server.run(place, search.line, step, event=event)
    said = f"{search.line}: {event} at {step}: {code}: {told}"
    assert "Traceback" not in told, said
    if event == "stopped":
        assert code == 0, said
    else:
        ended = code == 130 and "interrupted;" in told.splitlines()[-1]
        assert ended or code == 0, said  # training ends after its step, and a finished one has nothing to end
        code, _, told = search.server.run(place, search.line)
        if code == 2:
            assert "--force" in told, f"{said}; again: {told}"
            code, _, told = search.server.run(place, f"{search.line} --force")
        assert code == 0, f"{said}; again: {told}"
    search.compare(place, said)


@pytest.mark.parametrize("condition", CONDITIONS)
def test_a_condition_of_a_service_changes_nothing(condition, search):
    check_condition(search, condition)


@pytest.mark.parametrize("event", ["hung_up", "terminated", "stopped"])
def test_an_event_ends_right_or_in_a_sentence(event, search):
    check_event(search, event, search.events // 2)


@pytest.mark.slow
@pytest.mark.parametrize("line", LINES)
def test_every_command_works_as_a_service(line, server, work, tmp_path):
    search = Search(server, work, tmp_path, line)
    chance = random.Random(line)
    faults = []
    for condition in CONDITIONS:
        try:
            check_condition(search, condition)
        except AssertionError as error:
            faults.append(str(error).partition("\nassert")[0])
    for event in ("hung_up", "terminated", "stopped"):
        for step in chance.sample(range(1, search.events + 1), min(4, search.events)):
            try:
                check_event(search, event, step)
            except AssertionError as error:
                faults.append(str(error).partition("\nassert")[0])
    assert not faults, "\n".join(faults)
