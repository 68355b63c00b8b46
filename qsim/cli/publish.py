"""Runs `qsim publish`: a data set as shards that other programs load, in a folder or in object storage."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, get_args

from qsim.cli.command import Idle, command
from qsim.cli.console import RESUMES, WITHOUT_FORCE, bar, output, running
from qsim.cli.setting_options import records_of
from qsim.kinds import Positive, Text
from qsim.publishing.contents import FIELDS
from qsim.publishing.publication import Publication
from qsim.publishing.record import Kind
from qsim.settings import setting, settings_of
from qsim.streams.sensing import Sensing
from qsim.words import part_of

DEFAULT = "quiver-physical"
SENSED = tuple(one.name for one in settings_of(Sensing) if one.name != "name")  # a name is made of the settings


@dataclass(frozen=True)
class Publish:
    """What `qsim publish` writes, and where."""

    data: Annotated[
        Path,
        setting("data set or clip; its stored streams, or, with any setting of codes, those drawn", positional=True),
    ]
    output: Annotated[Text, setting("folder, or an address of fsspec, as in s3://bucket/set", short="o")]
    to: Annotated[Text, setting("format", choices=get_args(Kind))] = "webdataset"
    fields: Annotated[
        tuple[Text, ...] | None, setting("fields, comma-separated", unset="all of them", choices=FIELDS)
    ] = None
    packed: Annotated[bool, setting("keep the bits of codes packed in bytes")] = False
    shard_size: Annotated[Positive, setting("size of a shard, about, before compression", unit="MB")] = 256.0
    licence: Annotated[Text | None, setting("licence of the set, as in CC-BY-4.0")] = None
    shard: Annotated[
        tuple[int, int] | None,
        setting("only the I-th of N parts of the shards, as in 7/100", shown="I/N", read=part_of),
    ] = None
    force: Annotated[bool, setting("replace another published set")] = False


IDLE = (
    Idle(
        lambda asked, _: "writes a part, and --force replaces all; run without it first" if asked.shard else "",
        ("force",),
    ),
    Idle(lambda asked, _: _without_codes(asked), ("packed", *SENSED)),
)


def _without_codes(asked: Publish) -> str:
    """Return why settings of codes do nothing."""
    if asked.fields is None or {"codes", "truth"} & set(asked.fields):
        return ""
    return "is of codes and their truth, which --fields leaves out"


@command(
    "qsim publish out/starter -o out/published",
    "qsim publish out/starter -o out/parquet --to parquet --licence CC-BY-4.0",
    "qsim publish out/starter -o s3://bucket/starter --sensor spad-320x240 --bits 1 --ppp 1,3.25 --packed",
    "qsim publish /data/mine -o /data/published --shard 7/100",
    after_interrupt=RESUMES,
    idle=IDLE,
)
def publish(asked: Publish, sensing: Annotated[dict[str, Any], Sensing, *SENSED, {"sensor": DEFAULT}]) -> int:
    """Write the shards that are missing; with the last one the data card and Croissant metadata."""
    from qsim.publishing.publication import publish as write

    if asked.force:
        running().after_interrupt = WITHOUT_FORCE
    wanted = Publication(
        to=asked.to,  # type: ignore[arg-type]
        fields=FIELDS if asked.fields is None else asked.fields,  # type: ignore[arg-type]
        packed=asked.packed,
        shard_size=asked.shard_size,
        licence=asked.licence,
        sensings=_sensings(sensing),
    )
    with bar("publishing", "clip") as progress:
        made = write(asked.data, asked.output, wanted, part=asked.shard, force=asked.force, progress=progress)
    begun = f"{_counted(made.clips, 'clip')} in {_counted(made.shards, 'shard')}, {made.made} written now"
    begun += f", {made.size / 1e6:.1f} MB"
    left = "" if made.complete else "; other parts are missing, and the data card comes with the last one"
    output(dataclasses.asdict(made), f"{made.address}: {begun}{left}")
    return 0


def _counted(number: int, what: str) -> str:
    """Return `1 clip` or `2 clips`."""
    return f"{number} {what}{'s' * (number != 1)}"


def _sensings(given: dict[str, Any]) -> tuple[Sensing, ...]:
    """Return the codes to draw; none without a setting of them, when those that are stored are published."""
    if not given:
        return ()
    made: Sequence[Sensing] = records_of(Sensing, {"sensor": DEFAULT} | given)
    return tuple(made)
