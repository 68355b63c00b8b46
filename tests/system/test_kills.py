"""Every command that writes, killed at a file operation: the same command ends in the right result, or names the cure.

The right result is that of a run that nothing disturbed, with no file beside it. `-m slow` kills at every operation.
"""

from __future__ import annotations

import random

import pytest
from writing_commands import LINES, Search

QUICK = (
    "qsim convert codes.npy c --layout codes --bits 3 --frame-rate 9",
    "qsim convert clip e --to png",
    "qsim convert clip e.mp4",
    "qsim preview clip -o p.gif",
    "qsim explore clip -o x.html",
)


@pytest.mark.parametrize("line", QUICK)
def test_a_killed_command_is_finished_by_the_same_command(line, server, work, tmp_path):
    search = Search(server, work, tmp_path, line)
    steps = random.Random(line).sample(range(1, search.events + 1), 2)
    search.killed(steps[0], force=False)
    search.killed(steps[1], force=True)


@pytest.mark.slow
@pytest.mark.parametrize("line", LINES)
def test_a_command_killed_anywhere_is_finished_by_the_same_command(line, server, work, tmp_path):
    search = Search(server, work, tmp_path, line)
    faults = []
    for force in (False, True):
        for step in range(1, search.events + 3 * force):  # with --force there is more to remove
            try:
                search.killed(step, force)
            except AssertionError as error:
                faults.append(str(error).partition("\n")[0])
    assert not faults, "\n".join(faults)
