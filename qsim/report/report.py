"""Builds one self-contained HTML page for the clips, data sets, runs, restored video and scores under paths.

    clip.json            -> truth, codes, naive mean and flow as moving pictures; light, motion, error (clip_section.py)
    dataset.json         -> a table of the clips, and one clip of each split
    restored .json       -> restored video beside its codes and, if the clip is there, its truth and flow
    runs, scores, studies, validations -> tables and curves (table_sections.py)

The page shows stored results; from stored pictures it computes only their PSNR and error. A player shows at most
`panels.FRAMES` frames.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from qsim import colour, files
from qsim.clip.clamped_error import stated, white_in
from qsim.clip.motion_statistics import MOVING
from qsim.dataset.dataset import Dataset
from qsim.files import Progress
from qsim.report import html as page
from qsim.report import table_sections
from qsim.report.clip_section import clip_section, motion
from qsim.report.panels import (
    chosen_frames,
    error_panel,
    fit,
    legend,
    light_name,
    of_first,
    score,
    stream_panels,
    toned,
    truth_panels,
    truth_photons,
)
from qsim.restored_video import Restored, RestoredInfo, describes_restored
from qsim.streams.clip import Clip
from qsim.streams.stream import Stream

# at most on top of a page
_SENTENCES = 4
_FACTS = 8
_STORY = ("dataset", "training", "evaluation", "static", "restored", "study", "clip")  # the kinds in that order
INSIDE_CLIPS = {"streams", "events", "truth", "radiance", "sharp", "jobs", "failed", "logs", "locks", "work"}


def build_page(
    *paths: Path, title: str | None = None, notes: list[str] | None = None, progress: Progress | None = None
) -> str:
    """Return the page for these paths as HTML, with `notes` on top; raise `ValueError` if one has nothing known.

    A result that lies under several of the paths is shown once. `progress(done, total)` is called after each result;
    each clip of a data set counts as one.
    """
    kinds = {file.resolve(): (file, kind) for path in paths for file, kind in _results(path)}
    found = [(kind, file) for wanted in _ORDER for file, kind in kinds.values() if kind == wanted]
    total = sum(_steps(kind, file) for kind, file in found)
    done = 0
    drawn: list[tuple[str, page.Section]] = []

    def step() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    for kind, file in found:
        if kind == "dataset":
            drawn += [(kind, section) for section in dataset_sections(file, step)]
        else:
            drawn.append((kind, _DRAW[kind](file)))
            step()
    sections = [section for _, section in drawn]
    about = [page.section("About this page", page.bullets(notes))] if notes else []
    story, facts = _top(drawn)
    count = f"{len(drawn)} result{'s' if len(drawn) > 1 else ''} under {', '.join(map(str, paths))}."
    title = title or f"qsim report: {', '.join(path.name for path in paths)}"
    return page.page(title, [count, *story], facts, [*about, *sections])


def _top(drawn: list[tuple[str, page.Section]]) -> tuple[list[str], list[page.Fact]]:
    """Return sentences and numbers for the top of a page: of the first section of each kind, in the order of _STORY."""
    first = dict(reversed(drawn))
    told = [first[kind] for kind in _STORY if kind in first]
    facts = [fact for section in told for fact in section.facts]
    return [section.story for section in told if section.story][:_SENTENCES], facts[:_FACTS]


def _results(path: Path) -> list[tuple[Path, str]]:
    """Return the description and the kind of every result at or below `path`; `ValueError` if there is none."""
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder")
    found = [(file, kind) for file in _known_files(path) if (kind := _kind(file)) is not None]
    if not found:
        raise ValueError(f"{path}: nothing to report; expected a clip, a data set, a restored video or an evaluation")
    return found


def _known_files(path: Path) -> list[Path]:
    """Return the JSON files at or below `path`, without those inside clips and the clips of a data set.

    An array is described by the JSON file beside it.
    """
    if path.is_file():
        sidecar = path.with_suffix(".json")
        return [sidecar if sidecar.is_file() else path]
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
    if describes_restored(found):
        return "restored"
    for kind in ("evaluation", "static"):
        if str(found.get("format", "")).startswith(f"quiver-{kind}-"):
            return kind
    return next((kind for kind, keys in _KEYS if keys <= found.keys()), None)


# Kinds of files without a format field, and the keys that identify them
_KEYS = (
    ("bench", {"setting", "costs"}),
    ("validation", {"rows", "ok", "pixels"}),  # of sensors
    ("validation", {"rows", "ok", "median_ratio"}),  # of rendering; those of light and engines have no section
    ("reading", {"clip_processor", "mp4_processor"}),
    ("study", {"rows", "structure_function"}),
    ("study", {"cells", "studies"}),
    ("study", {"figure", "rows"}),
)


def _steps(kind: str, file: Path) -> int:
    """Return the number of steps for one file: the clips of a data set, otherwise one."""
    return len(Dataset.open(file.parent).names()) if kind == "dataset" else 1


def dataset_sections(path: Path, step: Callable[[], None] = lambda: None) -> list[page.Section]:
    """Return a table of the clips of a data set and the first clip of each split; call `step` after each clip."""
    data = Dataset.open(path.parent)
    rows = []
    below = set()
    splits = []
    total = 0
    for index in data.indices().tolist():
        clip = Clip.open(data.folder(index))
        split = data.listing.scene(index)[0].split
        splits.append(split)
        frames, height, width = clip.shape
        total += frames
        mean, largest = motion(clip, [len(clip) // 2]) if clip.has_truth else (None, None)
        size = f"{frames} × {height} × {width}"
        found = stated(clip.info)
        rows.append(
            [
                clip.name,
                split,
                size,
                clip.mean_radiance,
                clip.info.mean_photons,
                mean,
                largest,
                None if found is None else found.psnr,
            ]
        )
        below |= set() if found is None else {found.below.split(" (")[0]}
        step()
    headers = [
        "clip",
        "split",
        "frames × rows × columns",
        "mean radiance",
        "photons per pixel",
        "motion [px/frame]",
        "largest [px/frame]",
        "noise floor [dB]",
    ]
    missing = f"; missing: {', '.join(data.missing)}" if data.missing else ""
    caption = (
        f"{len(rows)} clips{missing}; motion in the middle frame, of pixels that move more than {MOVING:g} px; noise "
        f"floor: PSNR of the rendered light below {' or '.join(sorted(below)) or 'white'}"
    )
    counts = ", ".join(f"{splits.count(split)} {split}" for split in dict.fromkeys(splits))
    story = f"Data set {data.name} has {len(rows)} clips ({counts}) with {total} frames in all."
    facts = [page.Fact(str(len(rows)), f"clips in {data.name}"), page.Fact(str(total), "frames in all")]
    table = page.table(page.Table(caption, headers, rows))
    overview = page.section(f"Data set {data.name}", table, story=story, facts=facts)
    shown = [clip for split in ("test", "train", "val") for clip in data.clips(split)[:1]]
    return [overview, *(clip_section(clip) for clip in shown)]


def restored_section(path: Path) -> page.Section:
    """Return restored video beside its codes and truth, with the error of each.

    All have one white, but codes whose brightest light is less are white there.

    Flow, depth, bodies and hidden points of the clip lie over its light.
    """
    video = Restored.open(path)
    info = video.info
    restored = video.frames()
    frames = chosen_frames(len(restored), *restored.shape[-2:])
    shown = np.asarray(restored[: len(frames)])
    clip, stream = _source(info)
    name = info.method
    truth = None
    panels: list[page.Panel] = []
    if clip is not None and stream is not None:
        truth = truth_photons(clip, stream, frames)
    white = colour.peak(shown if truth is None else truth)
    own = page.Panel(f"restored by {name}", fit(toned(shown, white)), score(shown, truth))
    wheel = None
    lines = [f"{info.description or name}; {page.seconds_text(info.seconds_per_frame)} per frame."]
    if clip is None or stream is None or truth is None:
        panels = [own]
        if clip is None and Path(info.source or "none").with_suffix(".json").is_file():
            lines.append("Its stream was replaced since: the video is shown without codes and light.")
    else:
        light = page.Panel(light_name(clip), fit(toned(truth, white)))
        panels = [light, own, error_panel(name, shown, truth), *stream_panels(stream, frames, truth)]
        lines.append(
            f"PSNR of {len(frames)} frames against the {light_name(clip)}, both clamped at "
            f"{white_in(truth):.3g} photons. Codes are shown as the light at which they are the mean code."
        )
        if clip.has_truth:
            overlays, largest, _ = truth_panels(clip, frames)
            panels += overlays[1:]  # the first is the light again
            wheel = legend(largest)
    lines.append(f"Brightest light shown: {white:.3g} photons.")
    which = of_first(frames, len(restored))
    found = f" with a PSNR of {own.score}{which}" if own.score else ""
    seen = (
        f"{clip.name}, seen as {stream.name},"
        if truth is not None and clip is not None and stream is not None
        else path.stem
    )
    story = f"{seen} is restored by {name}{found}."
    facts = [page.Fact(own.score, f"PSNR of {path.stem}{which}")] if own.score else []
    player = page.player(panels, left=len(panels) - 1 if len(panels) < 4 else 3, right=1 if len(panels) > 1 else 0)
    return page.section(f"Restored: {path.stem}", player, page.bullets(lines), wheel, story=story, facts=facts)


def _source(info: RestoredInfo) -> tuple[Clip | None, Stream | None]:
    """Return the clip and stream of a restored video, or (None, None) if they are no longer there, or were replaced."""
    path = Path(info.source or "none")
    try:
        clip = Clip.open(path.parents[1])
        stream = Stream.open(path.with_suffix(".json"))
    except (IndexError, ValueError, OSError):
        return None, None
    now = stream.info.sha256
    shape = info.shape or stream.shape
    same = (info.source_sha256 or now) == now and (shape[0], *shape[-2:]) == tuple(stream.shape)
    return (clip, stream) if same else (None, None)


_DRAW: dict[str, Callable[[Path], page.Section]] = {
    "restored": restored_section,  # moving pictures first
    "evaluation": table_sections.evaluation_section,
    "static": table_sections.static_section,
    "training": table_sections.training_section,
    "study": table_sections.study_section,
    "bench": table_sections.bench_section,
    "validation": table_sections.validation_section,
    "reading": table_sections.reading_section,
    "clip": lambda path: clip_section(Clip.open(path.parent)),
}

_ORDER = ("restored", "evaluation", "static", "training", "study", "bench", "validation", "reading", "dataset", "clip")
