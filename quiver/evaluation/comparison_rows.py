"""Stores the rows of an evaluation: a clip restored by a method at a light level, with its score or why it failed."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from qsim import opening
from quiver.evaluation import metrics
from quiver.evaluation.json_values import json_safe, number
from quiver.restoration.interface import RestoreOptions


@dataclass(frozen=True)
class ComparisonRow:
    """One clip restored by one method at one light level: a score, or the reason why there is none."""

    method: str
    description: str  # of the method, with a digest of its weights
    light: str
    clip: str
    scene: str
    score: metrics.Score | None = None
    seconds_per_frame: float = math.nan
    peak_bytes: int | None = None  # of memory while restoring: on a GPU all that was allocated, else what was added
    peak: float = math.nan  # photons per pixel that the scores refer to
    truth_psnr: float | None = None  # dB; lower bound of the score of a perfect restorer
    motion_pixels: tuple[int, ...] = ()  # per bin of breakdown.EDGES; empty where the clip has no flow
    motion_squares: tuple[float, ...] = ()  # squared error summed over them, matched, in units of the peak
    failure: str | None = None
    precision: str = RestoreOptions.precision
    cut: str = ""  # tiles of a frame where they change the answer, else empty
    device: str = "cpu"  # where it was restored
    threads: int | None = None  # of torch; None where nothing was restored

    @property
    def key(self) -> tuple[str, str, str, str, str, str]:
        """Return what must agree for an old result to count."""
        return self.method, self.description, self.light, self.clip, self.precision, self.cut

    @property
    def crop(self) -> str:
        """Return the name of the crops of this method with these settings."""
        settings = json.dumps([self.description, self.precision, self.cut])
        return f"{self.method} {hashlib.sha256(settings.encode()).hexdigest()[:8]}"

    def to_dict(self) -> dict[str, object]:
        """Return plain values for JSON: null for NaN, and the texts inf and -inf."""
        return json_safe(asdict(self), infinite=True)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> ComparisonRow:
        """Return the inverse of `to_dict`."""
        score = values.pop("score")
        if score is not None:
            score = metrics.Score(**{name: number(v) for name, v in score.items()})
        values |= {name: number(values[name]) for name in ("seconds_per_frame", "peak")}
        values |= {name: tuple(map(number, values[name])) for name in ("motion_pixels", "motion_squares")}
        truth = values.get("truth_psnr")
        return cls(score=score, **values | {"truth_psnr": None if truth is None else number(truth)})


def stored_rows(path: Path) -> list[ComparisonRow]:
    """Return the finished rows of a file, none without it; the incomplete last line of a killed writer is ended."""
    if not path.exists():
        return []
    text = opening.text(path)
    if not text.endswith("\n"):
        with open(path, "a", encoding="utf-8") as file:
            file.write("\n")
    return list(finished(text.splitlines()))


def finished(lines: Sequence[str]) -> Iterator[ComparisonRow]:
    """Yield the rows of a file whose last line may be incomplete. Failures are left out: they are tried again."""
    for line in lines:
        try:
            row = ComparisonRow.from_dict(json.loads(line))
        except (ValueError, KeyError, TypeError):
            continue
        if row.failure is None:
            yield row


def append(path: Path, row: ComparisonRow) -> None:
    """Append a row to a file and sync it."""
    with open(path, "a", encoding="utf-8") as file:
        file.write(json.dumps(row.to_dict(), sort_keys=True, allow_nan=False) + "\n")
        file.flush()
        os.fsync(file.fileno())
