"""Runs `qsim compare`: readouts of the same light side by side."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from qsim.cli.command import command
from qsim.cli.console import output
from qsim.kinds import Positive, Text
from qsim.settings import setting
from qsim.tables import text_table

if TYPE_CHECKING:
    from qsim.studies.readouts import ReadoutRow

_HEADER = ("stream", "sensor", "bits", "codes", "time [ms]", "photons", "PSNR [dB]", "MB/s")


@dataclass(frozen=True)
class Compare:
    """What `qsim compare` compares."""

    clip: Annotated[Path, setting("clip folder with streams or events", positional=True)]
    streams: Annotated[tuple[Text, ...], setting("names of streams and events, comma-separated", unset="all")] = ()
    span: Annotated[Positive | None, setting("seconds that are averaged", unset="the longest code")] = None


@command(
    "qsim compare out/readouts/clips/fan_0000",
    "qsim compare out/fan --streams spike,conventional --span 0.6e-3",
)
def compare(asked: Compare) -> int:
    """Print the rows of all readouts of a clip."""
    from qsim.streams.clip import Clip
    from qsim.studies import readouts

    found = readouts.compare(Clip.open(asked.clip), asked.streams, asked.span)
    lines = text_table([_cells(row) for row in found.rows], _HEADER, left=2)
    head = f"{found.clip}: {len(found.instants)} instants, {found.span * 1e3:.4g} ms each, against the sharp light"
    rows = [asdict(row) for row in found.rows]
    for row in rows:
        row["psnr_db"] = row["psnr_db"] if math.isfinite(row["psnr_db"]) else None  # JSON has no infinity
    output(asdict(found) | {"rows": rows}, [head, *lines, *found.remarks])
    return 0


def _cells(row: ReadoutRow) -> tuple[str, ...]:
    """Return the cells of a row of the table."""
    light = not row.stream
    return (
        row.stream or "(light, no noise)",
        "" if light else row.model,
        "" if row.bits is None else str(row.bits),
        "" if light else str(row.codes),
        f"{row.seconds * 1e3:.4g}",
        "" if row.ppp is None else f"{row.ppp:.4g}",
        f"{row.psnr_db:.2f}",
        "" if row.megabytes_per_second is None else f"{row.megabytes_per_second:.3g}",
    )
