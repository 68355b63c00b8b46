"""Runs `qsim events`: draws the events that an event camera reports of clips."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

from qsim.cli.command import Idle, command
from qsim.cli.console import MAKES_AGAIN, output, running
from qsim.cli.sense import clips_of, drawings
from qsim.settings import setting
from qsim.streams.event_sensing import EventSensing, sense_events


@dataclass(frozen=True)
class Events:
    """The clips that `qsim events` draws events of; what it draws are the `EventSensing`."""

    paths: Annotated[tuple[Path, ...], setting("clips or data sets", shown="PATH", positional=True)]
    force: Annotated[bool, setting("replace events of the same name")] = False


IDLE = (
    Idle(
        lambda asked, wanted: f"is of one light level, not of {len(wanted)}" if len(wanted) > 1 else "",
        ("name",),
    ),
)


@command(
    "qsim events out/fan --ppp 100",
    "qsim events out/fan --camera dvs-ideal --ppp 100 -o ideal",
    after_interrupt="the same command resumes with the missing events",
    idle=IDLE,
)
def events(asked: Events, wanted: tuple[EventSensing, ...]) -> int:
    """Draw the events that are missing."""
    if asked.force:
        running().after_interrupt = MAKES_AGAIN
    clips = [clip for path in asked.paths for clip in clips_of(path)]
    made = []
    lines = []
    for clip, (found, line), drawn in drawings(
        clips, wanted, partial(sense_events, force=asked.force), "drawing events"
    ):
        info = found.info
        facts = {"clip": str(clip.path), "name": found.name, "file": str(found.path), "made": drawn}
        facts |= {"events": info.events, "on": info.brighter, "following": info.following}
        facts |= {"seconds": info.seconds, "shape": list(info.shape), "ppp": info.light.ppp, "light": line}
        made.append(facts)
        begun = "wrote" if drawn else "exists already:"
        lines.append(f"{begun} {found.path}: {found.said}; {line}")
    output({"events": made}, lines)
    return 0
