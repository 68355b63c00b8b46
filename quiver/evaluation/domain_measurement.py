"""Measures a domain: one network against the classical methods, cell by cell, on clips used for nothing else.

    weights, clips, sensors x bits x light -> matched PSNR of the network and of the best classical method -> Domain

Scores are those of `quiver evaluate`: peak 2.5 times the mean light, the best factor behind the clamp, mean over clips.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from qsim import records
from qsim.files import VERSION, Progress, to_json
from qsim.locks import Lock
from quiver.data.clips import Clip, open_clips, peak_of
from quiver.data.codes import sensed
from quiver.data.illumination import Illumination, file_digests
from quiver.evaluation import metrics
from quiver.evaluation.comparison import in_memory
from quiver.model.weights import annotate, metadata_of
from quiver.restoration.domain import (
    CUT,
    KEY,
    METHODS_ARE,
    SENSOR,
    Cell,
    Domain,
    changes,
    merged,
    place_of,
    read_scope,
    stored,
)
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
    return hashlib.sha256(to_json([records.plain(clip.info) for clip in clips])).hexdigest()


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
    classical_of: Path | None = None,
) -> Domain:
    """Measure the missing cells of a weights file, and store each in its metadata at once.

    Several processes may measure one file. With `force`, requested cells are measured again, and cells measured
    otherwise (other clips, methods, seed or version) are removed. The tensors of the file are unchanged. The scores of
    classical methods are taken from the weights `classical_of` if given, and then only the network is measured.
    `ValueError` for methods that are not classical, for cells measured otherwise without `force`, and for cells that
    `classical_of` lacks.
    """
    methods = restorers(settings.methods, options)
    network = network_restorer(weights, options)
    if any(method.learned for method in methods):
        raise ValueError(f"a network is measured against classical methods, got {', '.join(settings.methods)}")
    shared = settings.to_dict() | {METHODS_ARE: [method.description for method in methods]}
    shared |= _run_of(network, settings.clips) | _sensor_files(settings.lights)
    before = read_scope(weights, metadata_of(weights)).domain
    changed = [] if before is None else changes(before.measured, shared)
    if before is not None and changed and not force:
        raise ValueError(
            f"{weights}: holds {len(before.cells)} cells that were measured otherwise (not the same: "
            f"{', '.join(changed)}); measure into a copy of the file, or replace them with force=True"
        )
    rivals = None if classical_of is None else _rivals(classical_of, shared, settings.lights)
    todo = [light for light in settings.lights if force or not _known(weights, shared, light)]
    for done, light in enumerate(todo):
        if progress is not None:
            progress(done, len(todo))
        if not force and _known(weights, shared, light):  # measured by another process in the meantime
            continue
        cell = measure_cell(network, methods, settings, light, None if rivals is None else rivals[light])
        with _one_at_a_time(weights):
            # Read again under the lock: another process may have added cells since.
            old = stored(weights, shared)
            annotate(weights, {KEY: Domain(merged(old.cells, [cell]), old.measured).to_json()})
    if progress is not None:
        progress(len(todo), max(1, len(todo)))
    return stored(weights, shared)


def _rivals(source: Path, shared: Mapping[str, object], lights: Sequence[Illumination]) -> dict[Illumination, Cell]:
    """Return the cells of other weights at these lights. `ValueError` for one that lacks or was measured otherwise."""
    domain = read_scope(source, metadata_of(source)).domain
    if domain is None:
        raise ValueError(f"{source}: was never measured; name weights whose classical scores are known, or none")
    changed = changes(domain.measured, shared)
    if changed:
        raise ValueError(
            f"{source}: was measured otherwise (not the same: {', '.join(changed)}); its classical scores do not hold"
        )
    found = {}
    for light in lights:
        cells = [cell for cell in domain.cells if _measures(cell, light)]
        if not cells:
            raise ValueError(f"{source}: holds no cell of {light.label}; leave this light out, or measure all methods")
        found[light] = cells[0]
    return found


def _run_of(network: Restorer, clips: Sequence[Clip]) -> dict[str, object]:
    """Return how a network runs as far as it changes results: mode and precision, if not the usual ones, and tiles."""
    usual = {"mode": RestoreOptions.mode, "precision": RestoreOptions.precision}
    given = {name: network.identity.get(name) or default for name, default in usual.items()}
    cuts = {network.cut(*clip.shape[1:]) for clip in clips} - {""}
    return {name: value for name, value in given.items() if value != usual[name]} | {CUT: ", ".join(sorted(cuts))}


def _sensor_files(lights: Sequence[Illumination]) -> dict[str, object]:
    """Return the SHA-256 of each sensor file. `ValueError` for different files of one name."""
    found: dict[str, object] = {}
    for sensor, digest in file_digests(lights).items():
        name = f"{SENSOR}{Path(sensor).name}"
        if found.setdefault(name, digest) != digest:
            raise ValueError(f"{sensor}: another sensor file has the same name, by which cells are stored; rename one")
    return found


def _known(weights: Path, shared: Mapping[str, object], light: Illumination) -> bool:
    return any(_measures(cell, light) for cell in stored(weights, shared).cells)


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


def measure_cell(
    network: Restorer,
    methods: Sequence[Restorer],
    settings: DomainSettings,
    light: Illumination,
    rival: Cell | None = None,
) -> Cell:
    """Return the cell of the network and the best method at one light, of a `rival` cell if its scores are known.
    `ValueError` where a clip has no score.
    """
    if rival is not None:
        own = _mean_score(network, settings, light)
        if not math.isfinite(own):
            raise ValueError(f"{light.label}: the network fails or has no score on these clips")
        return replace(rival, network=round(own, 3))
    own, *others = (_mean_score(method, settings, light) for method in (network, *methods))
    if not math.isfinite(own) or any(map(math.isinf, others)) or all(map(math.isnan, others)):
        raise ValueError(f"{light.label}: the network, or every classical method, fails or has no score on these clips")
    best = int(np.nanargmax(others))
    clip = settings.clips[0]
    assert light.ppp is not None
    exposure = clip.exposure * light.planes
    place = place_of(light.device(exposure), exposure, light.ppp)
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
    drawn, truth = sensed(clip, light, seed)
    peak = peak_of(truth.mean_light)
    restored = method.restore(in_memory(drawn))
    return metrics.score(restored / peak, truth.video() / peak, valid=truth.known()).psnr_matched
