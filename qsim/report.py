"""One self-contained HTML page for whatever lies under a path: clips, data sets, training runs, restored video, scores.

    clip.json         -> truth, codes, plain average, flow as moving pictures; light, motion, what was modelled
    dataset.json      -> a table of the clips, and one of the test split as a clip
    restored .json    -> restored video beside its codes and, where the clip is at hand, its truth
    history.json      -> the learning curve of a training run
    evaluation.json   -> the table of methods; a measured static object likewise

Nothing is computed here that is not in the files. A player shows at most `FRAMES` frames and `WIDTH` columns.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qsim import files, page, pictures
from qsim.clip import Clip, Stream
from qsim.dataset import Dataset
from qsim.optics import clip_photons

FRAMES = 48  # of a player
WIDTH = 512  # columns of a panel; wider pictures are shown smaller by a whole factor
AVERAGE = 11  # frames of the plain average, the window of QUIVER
INSIDE_CLIPS = {"streams", "truth", "radiance", "sharp", "jobs", "failed", "logs", "locks", "work"}


def build(path: Path, *, title: str | None = None, notes: list[str] | None = None) -> str:
    """The page for `path` as HTML text, with `notes` on top. `ValueError` if nothing under it is ours."""
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder")
    drawn = [_DRAW[kind](found) for kind in _DRAW for found in _known_files(path) if _kind(found) == kind]
    if not drawn:
        raise ValueError(f"{path}: nothing to report; expected a clip, a data set, a restored video or an evaluation")
    words = [page.section("About this page", page.bullets(notes))] if notes else []
    return page.page(title or f"qsim report: {path.name}", f"{len(drawn)} sections from {path}", [*words, *drawn])


def _known_files(path: Path) -> list[Path]:
    """JSON files at or below `path` that may be ours: not the insides of clips, not the clips of a data set."""
    if path.is_file():
        return [path]
    candidates = [p for p in sorted(path.rglob("*.json")) if not INSIDE_CLIPS & set(p.relative_to(path).parts[:-1])]
    sets = [p.parent / "clips" for p in candidates if p.name == "dataset.json"]
    return [p for p in candidates if not any(folder in p.parents for folder in sets)]


def _kind(path: Path) -> str | None:
    """What a JSON file describes: its name tells for folders, its `format` for single files; None if it is not ours."""
    names = {"clip.json": "clip", "dataset.json": "dataset", "history.json": "training"}
    if path.name in names:
        return names[path.name]
    try:
        name = str(files.read_json(path).get("format", ""))
    except ValueError:
        return None
    kinds = ("evaluation", "static", "restored")
    return next((kind for kind in kinds if name.startswith(f"quiver-{kind}-")), None)


# Moving pictures


def chosen_frames(count: int) -> range:
    """At most FRAMES frames from the start, without gaps: gaps would show another motion."""
    return range(min(count, FRAMES))


def _fit(frames: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Every n-th row and column so that a panel stays within WIDTH."""
    step = -(-frames.shape[2] // WIDTH)
    return frames[:, ::step, ::step]


def truth_stack(clip: Clip, frames: range) -> NDArray[np.float32]:
    """Sharp radiance [T, H, W] of these frames."""
    return np.stack([clip.sharp(t) for t in frames])


def stream_panels(stream: Stream, frames: range) -> list[page.Panel]:
    """Codes as they are, and the plain average of up to 11 frames around each."""
    reach = AVERAGE // 2
    first, last = max(frames.start - reach, 0), min(frames.stop + reach, len(stream))
    codes = stream.codes(first, last)
    bits = int(stream.meta["bits"])
    averages = np.stack(
        [codes[max(t - reach - first, 0) : t + reach + 1 - first].mean(axis=0) / (2**bits - 1) for t in frames]
    )
    shown = codes[frames.start - first : frames.stop - first]
    return [
        page.Panel(f"codes, {bits} bit ({stream.name})", _fit(pictures.code_levels(shown, bits))),
        page.Panel(f"plain average of {AVERAGE} frames", _fit(pictures.tone(averages, pictures.peak(averages)))),
    ]


def clip_section(clip: Clip) -> str:
    """Truth, streams and flow of a clip, its light, its motion, and what was modelled."""
    frames = chosen_frames(len(clip))
    truth = truth_stack(clip, frames)
    white = pictures.peak(truth)
    panels = [page.Panel("truth", _fit(pictures.tone(truth, white)))]
    for name in clip.streams:
        stream = clip.stream(name)
        if len(stream) >= len(frames):
            panels += stream_panels(stream, frames)
    parts = []
    if clip.has_truth:
        flow = np.stack([clip.flow(t) for t in frames])
        speed = np.hypot(flow[:, 0], flow[:, 1])
        largest = max(float(np.nanpercentile(speed, 99.9)), 0.5)
        panels.append(
            page.Panel(f"flow, full colour at {largest:.1f} px/frame", _fit(pictures.flow_colours(flow, largest)))
        )
        parts.append(page.figure(_motion_histogram(speed), "motion between neighbouring frames, all pixels"))
    lines = [light_line(clip), *modelled(clip.meta)]
    return page.section(f"Clip {clip.name}", page.player(panels), page.bullets(lines), *parts)


def light_line(clip: Clip) -> str:
    """Size, rate and light of a clip in one sentence."""
    frames, height, width = clip.shape
    unit = "(relative)" if clip.camera is None else "W m⁻² sr⁻¹"
    return (
        f"{frames} frames of {height} × {width} at {clip.frame_rate:g} fps, exposure {clip.exposure * 1e6:.4g} µs, "
        f"mean radiance {clip.mean_radiance:.4g} {unit}"
    )


def modelled(meta: dict[str, Any]) -> list[str]:
    """What a renderer says it modelled and left out, and the measured error, as lines."""
    render = meta.get("render", {})
    lines = [f"{f['effect']}: {f['chosen']} ({f['size']})" for f in render.get("findings", [])]
    errors = meta.get("error_per_frame")
    if errors:
        lines.append(f"Monte-Carlo error per frame: rms {float(np.sqrt(np.mean(np.square(errors)))):.3g} of radiance")
    if meta.get("psnr_of_truth") is not None:
        lines.append(f"PSNR of the truth itself: {meta['psnr_of_truth']:.1f} dB")
    return lines


def dataset_section(path: Path) -> str:
    """A table of the clips of a data set, and the first test clip in pictures."""
    data = Dataset.open(path.parent)
    rows = []
    for name in data.names():
        clip = Clip.open(data.path / "clips" / name)
        split = data.meta["jobs"][name]["split"]
        frames, height, width = clip.shape
        rows.append([name, split, f"{frames} × {height} × {width}", clip.mean_radiance, clip.meta.get("psnr_of_truth")])
    headers = ["clip", "split", "frames × rows × columns", "mean radiance", "truth's own PSNR [dB]"]
    overview = page.section(f"Data set {data.name}", page.table(page.Table(f"{len(rows)} clips", headers, rows)))
    shown = data.clips("test")[:1] or data.clips()[:1]
    return overview + "".join(clip_section(clip) for clip in shown)


def restored_section(path: Path) -> str:
    """Restored video beside its codes and truth, all at one white."""
    meta = files.read_json(path)
    restored = np.load(path.with_suffix(".npy"), mmap_mode="r")
    frames = chosen_frames(len(restored))
    shown = np.asarray(restored[: len(frames)])
    clip, stream = _source(meta)
    panels: list[page.Panel] = []
    white = pictures.peak(shown)
    if clip is not None and stream is not None and len(clip) >= len(frames):
        photons = np.stack([clip_photons(clip, t, stream.photons_factor, sharp=True) for t in frames])
        white = pictures.peak(photons)
        panels = [page.Panel("truth", _fit(pictures.tone(photons, white))), *stream_panels(stream, frames)]
    panels.append(page.Panel(f"restored by {meta['method']}", _fit(pictures.tone(shown, white))))
    line = (
        f"{meta['description']}; {meta['seconds_per_frame']:.3g} s per frame; pictures are white at {white:.3g} photons"
    )
    return page.section(f"Restored: {path.stem}", page.text(line), page.player(panels))


def _source(meta: dict[str, Any]) -> tuple[Clip | None, Stream | None]:
    """The clip and stream that a restored video came from, where they are still at hand."""
    stream = Path(str(meta.get("source", "")))
    try:
        return Clip.open(stream.parents[1]), Stream.open(stream.with_suffix(".json"))
    except (IndexError, ValueError, OSError):
        return None, None


def training_section(path: Path) -> str:
    """The learning curve: PSNR of the validation clips against minutes."""
    history = files.read_json(path)["history"]
    axes, save = _axes("minutes of training", "validation PSNR, matched [dB]")
    axes.plot([entry["elapsed"] / 60 for entry in history], [entry["psnr_matched"] for entry in history], ".-")
    last = history[-1]
    words = f"{last['step']} steps in {last['elapsed'] / 60:.1f} minutes; last {last['psnr_matched']:.2f} dB"
    return page.section(f"Training: {path.parent.name}", page.figure(save(), words))


def evaluation_section(path: Path) -> str:
    """Methods on held-out clips: means and 95 % intervals over scenes, best matched PSNR of each light level bold."""
    found = files.read_json(path)
    rows = [
        [
            line["method"],
            line["light"],
            _pm(line["scores"]["psnr"], 2),
            _pm(line["scores"]["psnr_matched"], 2),
            _pm(line["scores"]["ssim_matched"], 3),
            line["seconds_per_frame"],
            line["truth_psnr"],
        ]
        for line in found["table"]
    ]
    scores = [line["scores"]["psnr_matched"]["mean"] for line in found["table"]]
    lights = [line["light"] for line in found["table"]]
    best = {max((i for i, own in enumerate(lights) if own == light), key=lambda i: scores[i] or -1) for light in lights}
    headers = ["method", "light", "PSNR [dB]", "PSNR matched [dB]", "SSIM matched", "s/frame", "truth's own PSNR [dB]"]
    caption = "mean ± half of the 95 % interval over scenes; matched = after one best factor per clip"
    missing = f"Not built yet: {', '.join(found['not_built_yet'])}." if found.get("not_built_yet") else ""
    table = page.table(page.Table(caption, headers, rows, frozenset(best)))
    return page.section(f"Methods compared: {path.parent.name}", table, page.text(missing))


def _pm(interval: dict[str, Any], digits: int) -> str:
    """`23.45 ± 0.67`, without the half-width where there is one scene."""
    mean, half = interval["mean"], interval["half_width"]
    if not isinstance(mean, int | float):
        return "failed"
    return f"{mean:.{digits}f}" + (f" ± {half:.{digits}f}" if isinstance(half, int | float) else "")


def static_section(path: Path) -> str:
    """Measured photons of a static object: restored from some frames, scored against the others."""
    found = files.read_json(path)
    headers = ["method", "PSNR [dB]", "PSNR matched [dB]", "spread over splits [dB]", "with the reference's noise [dB]"]
    keys = ("method", "psnr", "psnr_matched", "psnr_matched_spread", "psnr_as_measured")
    rows = [[score[key] for key in keys] for score in found["scores"]]
    caption = (
        f"{Path(found['counts']).name}: real photons clipped to {found['bits']} bits, restored from {found['frames']} "
        "frames, scored against the others; the reference's own variance is taken off"
    )
    return page.section("Real photons", page.table(page.Table(caption, headers, rows)))


def _motion_histogram(speed: NDArray[np.floating]) -> bytes:
    """Share of pixels against px/frame, as a PNG."""
    axes, save = _axes("motion [px/frame]", "share of pixels")
    known = speed[np.isfinite(speed)]
    axes.hist(known, bins=48, weights=np.full(known.size, 1 / max(known.size, 1)), color="tab:blue")
    axes.set_yscale("log")
    return save()


def _axes(x_label: str, y_label: str) -> tuple[Any, Any]:
    """One small set of axes, and a function that gives its picture as PNG bytes."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(6.4, 3.0), dpi=110, layout="constrained")
    axes = drawing.subplots()
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.grid(alpha=0.3)

    def save() -> bytes:
        buffer = io.BytesIO()
        drawing.savefig(buffer, format="png")
        return buffer.getvalue()

    return axes, save


_DRAW: dict[str, Callable[[Path], str]] = {
    "evaluation": evaluation_section,
    "static": static_section,
    "restored": restored_section,
    "training": training_section,
    "dataset": dataset_section,
    "clip": lambda path: clip_section(Clip.open(path.parent)),
}
