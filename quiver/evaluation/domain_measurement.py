"""Measures a domain: one network against the classical methods, cell by cell, on clips used for nothing else.

    weights, clips, sensors x bits x light -> matched PSNR of the network and of the best classical method -> Domain

Scores are those of `quiver evaluate`: peak 2.5 times the mean light, the best factor behind the clamp, mean over clips.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from qsim.files import VERSION, Progress
from qsim.locks import Lock
from quiver.data.clips import Clip, known, mean_light, open_clips, peak_of, truth
from quiver.data.codes import sensed
from quiver.data.illumination import Illumination
from quiver.evaluation import metrics
from quiver.evaluation.comparison import in_memory
from quiver.model.weights import annotate, metadata_of
from quiver.restoration.domain import KEY, Cell, Domain, merged, place_of, read_scope
from quiver.restoration.interface import RestoreOptions, Restorer
from quiver.restoration.networks import network_restorer
from quiver.restoration.restorers import restorers

CLASSICAL = ("naive", "moment:3", "transform-denoise", "qbp", "qbp-bm3d")


@dataclass(frozen=True)
class DomainSettings:
    """The settings of a measurement."""

    clips: tuple[Clip, ...]
    lights: tuple[Illumination, ...]
    methods: tuple[str, ...] = CLASSICAL
    seed: int = 0

    def to_dict(self) -> dict[str, object]:
        """Return what all cells of a domain share; stored with them."""
        return {
            "clips": [clip.name for clip in self.clips],
            "clips_sha256": clips_digest(self.clips),
            "frames": sum(len(clip) for clip in self.clips),
            "methods": list(self.methods),
            "seed": self.seed,
            "score": "matched PSNR, peak 2.5 x mean light, mean over clips",
            "quiver": VERSION,
        }


def clips_digest(clips: Sequence[Clip]) -> str:
    """Return the SHA-256 of the descriptions of the clips, which include the checksums of their files."""
    return hashlib.sha256(json.dumps([clip.meta for clip in clips], sort_keys=True).encode()).hexdigest()


def clips_of(sources: Sequence[Path], split: str | None) -> tuple[Clip, ...]:
    """Return the clips of several data sets (of one split) and clip folders. `ValueError` if there are none."""
    clips = tuple(clip for source in sources for clip in open_clips(source, split))
    if not clips:
        raise ValueError(f"no finished clip in split {split!r} of {', '.join(str(source) for source in sources)}")
    return clips


def measure(
    weights: Path,
    settings: DomainSettings,
    options: RestoreOptions,
    progress: Progress | None = None,
    *,
    force: bool = False,
) -> Domain:
    """Measure the missing cells of a weights file, and store each in its metadata at once.

    Several processes may measure one file. With `force`, requested cells are measured again, and cells measured
    otherwise (other clips, methods, seed or version) are removed. The tensors of the file are unchanged.
    `ValueError` for methods that are not classical, and for cells measured otherwise without `force`.
    """
    methods = restorers(settings.methods, options)
    network = network_restorer(weights, options)
    if any(method.learned for method in methods):
        raise ValueError(f"a network is measured against classical methods, got {', '.join(settings.methods)}")
    shared = settings.to_dict()
    before = read_scope(weights, metadata_of(weights)).domain
    if before is not None and dict(before.measured) != shared and not force:
        changed = ", ".join(key for key, value in shared.items() if before.measured.get(key) != value)
        raise ValueError(
            f"{weights}: holds {len(before.cells)} cells that were measured otherwise (not the same: {changed}); "
            "measure into a copy of the file, or use --force to replace them"
        )
    todo = [light for light in settings.lights if force or not _known(weights, shared, light)]
    for done, light in enumerate(todo):
        if progress is not None:
            progress(done, len(todo))
        if not force and _known(weights, shared, light):  # measured by another process in the meantime
            continue
        cell = measure_cell(network, methods, settings, light)
        with _one_at_a_time(weights):
            cells = merged(stored_cells(weights, shared), [cell])
            annotate(weights, {KEY: Domain(cells, shared).to_json()})
    if progress is not None:
        progress(len(todo), max(1, len(todo)))
    return Domain(stored_cells(weights, shared), shared)


def stored_cells(weights: Path, shared: Mapping[str, object]) -> tuple[Cell, ...]:
    """Return the cells in a weights file that were measured with these settings."""
    domain = read_scope(weights, metadata_of(weights)).domain
    return domain.cells if domain is not None and dict(domain.measured) == shared else ()


def _known(weights: Path, shared: Mapping[str, object], light: Illumination) -> bool:
    return any(_measures(cell, light) for cell in stored_cells(weights, shared))


@contextlib.contextmanager
def _one_at_a_time(weights: Path) -> Iterator[None]:
    """Prevent other processes from rewriting the file between our reading and our writing."""
    lock = Lock(weights.with_name(f"{weights.name}.lock"))
    lock.acquire(wait=True)
    try:
        yield
    finally:
        lock.delete()


def _measures(cell: Cell, light: Illumination) -> bool:
    return (cell.sensor, cell.place.bits, cell.ppp) == (Path(light.sensor).name, light.bits, light.ppp)


def measure_cell(network: Restorer, methods: Sequence[Restorer], settings: DomainSettings, light: Illumination) -> Cell:
    """Return the cell of the network and the best method at one light. `ValueError` where a clip has no score."""
    own, *others = (_mean_score(method, settings, light) for method in (network, *methods))
    if not (math.isfinite(own) and any(map(math.isfinite, others))):
        raise ValueError(f"{light.label}: the network, or every classical method, fails or has no score on these clips")
    best = int(np.nanargmax(others))
    clip = settings.clips[0]
    assert light.ppp is not None
    place = place_of(light.device(clip.exposure), clip.exposure, light.ppp)
    return Cell(Path(light.sensor).name, light.ppp, place, round(own, 3), methods[best].name, round(others[best], 3))


def _mean_score(method: Restorer, settings: DomainSettings, light: Illumination) -> float:
    """Return the mean over clips; NaN for a classical method that cannot restore such codes and so is left out."""
    try:
        return float(np.mean([score(method, clip, light, settings.seed) for clip in settings.clips]))
    except ValueError:
        if method.learned:
            raise
        return math.nan


def score(method: Restorer, clip: Clip, light: Illumination, seed: int) -> float:
    """Return the matched PSNR [dB] of one clip restored by one method."""
    drawn, factor = sensed(clip, light, seed)
    peak = peak_of(mean_light(clip, factor))
    restored = method.restore(in_memory(drawn))
    target = truth(clip, factor, 0, len(clip)) / peak
    return metrics.score(restored / peak, target, valid=known(clip, 0, len(clip))).psnr_matched
