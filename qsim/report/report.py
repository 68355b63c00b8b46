"""Builds one self-contained HTML page for the clips, data sets, runs, restored video and scores under a path.

    clip.json            -> truth, codes, naive mean and flow as moving pictures; light, motion, error (clip_section.py)
    dataset.json         -> a table of the clips, and one clip of each split
    restored .json       -> restored video beside its codes and, if the clip is there, its truth and flow
    runs, scores, studies, validations -> tables and curves (table_sections.py)

The page shows stored results only; nothing is recomputed. A player shows at most `clip_section.FRAMES` frames.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from qsim import colour, files
from qsim.clip.clamped_error import stated
from qsim.clip.clip import Clip
from qsim.clip.motion_statistics import MOVING
from qsim.clip.photons import clip_photons
from qsim.clip.stream import Stream
from qsim.dataset.checking import Restored
from qsim.dataset.dataset import Dataset
from qsim.files import Progress
from qsim.report import html as page
from qsim.report import table_sections
from qsim.report.clip_section import (
    chosen_frames,
    clip_section,
    fit,
    flow_panel,
    legend,
    light_name,
    motion,
    stream_panels,
)

if TYPE_CHECKING:
    from markupsafe import Markup

INSIDE_CLIPS = {"streams", "truth", "radiance", "sharp", "jobs", "failed", "logs", "locks", "work"}


def build_page(
    path: Path, *, title: str | None = None, notes: list[str] | None = None, progress: Progress | None = None
) -> str:
    """Return the page for `path` as HTML, with `notes` on top; raise `ValueError` if nothing under it is known.

    `progress(done, total)` is called after each result; each clip of a data set counts as one.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder")
    kinds = {file: _kind(file) for file in _known_files(path)}
    found = [(kind, file) for kind in _DRAW for file in kinds if kinds[file] == kind]
    total = sum(_steps(kind, file) for kind, file in found)
    done = 0
    drawn = []

    def step() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    for kind, file in found:
        drawn.append(dataset_section(file, step) if kind == "dataset" else _DRAW[kind](file))
        if kind != "dataset":
            step()
    if not drawn:
        raise ValueError(f"{path}: nothing to report; expected a clip, a data set, a restored video or an evaluation")
    words = [page.section("About this page", page.bullets(notes))] if notes else []
    return page.page(
        title or f"qsim report: {path.name}",
        f"{len(drawn)} section{'s' if len(drawn) > 1 else ''} from {path}",
        [*words, *drawn],
    )


def _known_files(path: Path) -> list[Path]:
    """Return the JSON files at or below `path`, without those inside clips and the clips of a data set."""
    if path.is_file():
        return [path]
    candidates = [p for p in sorted(path.rglob("*.json")) if not INSIDE_CLIPS & set(p.relative_to(path).parts[:-1])]
    sets = [p.parent / "clips" for p in candidates if p.name == "dataset.json"]
    return [p for p in candidates if not any(folder in p.parents for folder in sets)]


def _kind(path: Path) -> str | None:
    """Return the kind of result in a JSON file, by its name for folders, else by its contents; None if unknown."""
    names = {"clip.json": "clip", "dataset.json": "dataset", "history.json": "training"}
    if path.name in names:
        return names[path.name]
    try:
        found = files.read_json(path)
    except ValueError:
        return None
    for kind in ("evaluation", "static", "restored"):
        if str(found.get("format", "")).startswith(f"quiver-{kind}-"):
            return kind
    return next((kind for kind, keys in _KEYS if keys <= found.keys()), None)


# Kinds of files without a format field, and the keys that identify them
_KEYS = (
    ("bench", {"setting", "costs"}),
    ("validation", {"rows", "ok"}),
    ("reading", {"clip_processor", "mp4_processor"}),
    ("study", {"rows", "structure_function"}),
    ("study", {"cells", "studies"}),
    ("study", {"figure", "rows"}),
)


def _steps(kind: str, file: Path) -> int:
    """Return the number of steps for one file: the clips of a data set, otherwise one."""
    return len(Dataset.open(file.parent).names()) if kind == "dataset" else 1


def dataset_section(path: Path, step: Callable[[], None] = lambda: None) -> Markup:
    """Return a table of the clips of a data set and the first clip of each split; call `step` after each clip."""
    data = Dataset.open(path.parent)
    rows, below = [], set()
    for name in data.names():
        clip = Clip.open(data.path / "clips" / name)
        split = data.meta["jobs"][name]["split"]
        frames, height, width = clip.shape
        mean, largest = motion(clip, [len(clip) // 2]) if clip.has_truth else (None, None)
        size, found = f"{frames} × {height} × {width}", stated(clip.meta)
        rows.append([name, split, size, clip.mean_radiance, clip.meta.get("mean_photons"), mean, largest,
                     None if found is None else found.psnr])  # fmt: skip
        below |= set() if found is None else {found.below.split(" (")[0]}
        step()
    unit = " or ".join(sorted(below)) or "white"
    headers = [
        "clip", "split", "frames × rows × columns", "mean radiance", "photons per pixel",
        "motion of what moves [px/frame]", "largest", f"radiance's PSNR [dB below {unit}]",
    ]  # fmt: skip
    missing = f"; missing: {', '.join(data.missing)}" if data.missing else ""
    caption = f"{len(rows)} clips{missing}; motion in the middle frame, of pixels that move more than {MOVING:g} px"
    overview = page.section(f"Data set {data.name}", page.table(page.Table(caption, headers, rows)))
    shown = [clip for split in ("test", "train", "val") for clip in data.clips(split)[:1]]
    return page.together([overview, *(clip_section(clip) for clip in shown)])


def restored_section(path: Path) -> Markup:
    """Return restored video beside its codes and truth, all with one white."""
    video = Restored.open(path)
    meta, restored = video.meta, video.frames()
    frames = chosen_frames(len(restored))
    shown = np.asarray(restored[: len(frames)])
    clip, stream = _source(meta)
    panels: list[page.Panel] = []
    white = colour.peak(shown)
    if clip is not None and stream is not None and len(clip) >= len(frames):
        photons = np.stack([clip_photons(clip, t, stream.photons_factor, sharp=True) for t in frames])
        white = colour.peak(photons)
        panels = [page.Panel(light_name(clip), fit(colour.tone(photons, white))), *stream_panels(stream, frames)]
    place = len(panels)
    panels.append(page.Panel(f"restored by {meta['method']}", fit(colour.tone(shown, white))))
    wheel = None
    if clip is not None and len(panels) > 1 and clip.has_truth:
        panel, largest, _ = flow_panel(clip, frames)
        panels.append(panel)
        wheel = legend(largest)
    line = (
        f"{meta['description']}; {meta['seconds_per_frame']:.3g} s per frame; pictures are white at {white:.3g} photons"
    )
    return page.section(f"Restored: {path.stem}", page.text(line), page.player(panels, left=place), wheel)


def _source(meta: dict[str, Any]) -> tuple[Clip | None, Stream | None]:
    """Return the clip and stream of a restored video, or (None, None) if they are no longer there."""
    stream = Path(str(meta.get("source", "")))
    try:
        return Clip.open(stream.parents[1]), Stream.open(stream.with_suffix(".json"))
    except (IndexError, ValueError, OSError):
        return None, None


_DRAW: dict[str, Callable[[Path], Markup]] = {
    "restored": restored_section,  # moving pictures first
    "evaluation": table_sections.evaluation_section,
    "static": table_sections.static_section,
    "training": table_sections.training_section,
    "study": table_sections.study_section,
    "bench": table_sections.bench_section,
    "validation": table_sections.validation_section,
    "reading": table_sections.reading_section,
    "dataset": dataset_section,
    "clip": lambda path: clip_section(Clip.open(path.parent)),
}
