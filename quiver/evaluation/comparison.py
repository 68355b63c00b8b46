"""One table for all methods: scores on held-out clips at several light levels, with what the truth itself is worth.

    clips x lights -> codes (fixed keys) -> restored -> Score per clip -> mean and 95 % interval over scenes

All methods see the same codes of the same frames. Every result is written down when it is there, so an interrupted
evaluation goes on; a method that fails keeps its row, with the reason. Tables and figures: table.py. Real photons of a
static object: static.py.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.files import read_json, write_json
from qsim.process import peak_memory, reset_peak
from quiver.data.clips import Clip, known, mean_light, open_clips, peak_of, truth
from quiver.data.codes import Codes, array_codes, sensed, stored, windows_sensed
from quiver.data.illumination import Illumination
from quiver.evaluation import breakdown, metrics
from quiver.restoration.interface import Restorer

FORMAT = "quiver-evaluation-2"  # 1: peak = the sensor's white, factor of the least unclamped error
PLAN_FORMAT = "quiver-plan-2"
PUBLISHED_EDGE = 5  # frames at each end that the published evaluation leaves out

ComparisonProgress = Callable[[str, int, int], None]  # (what is restored, rows done, rows in all)


@dataclass(frozen=True)
class Comparison:
    """What is evaluated; stored beside the results."""

    source: str  # data set or clip folder
    split: str | None = "test"  # None = all clips
    lights: tuple[Illumination, ...] = (Illumination(),)
    seed: int = 0  # of the test noise: the same for all methods and all runs
    published: bool = False  # every window exposed, drawn, scaled and scored on its own; ends of clips left out
    stream: str | None = None  # score this stored stream instead of sensing at `lights`
    peak: float | None = None  # of the scores, photons per pixel; None = 2.5 x mean light (published: sensor's white)

    def to_dict(self) -> dict[str, Any]:
        plain: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        return plain


@dataclass(frozen=True)
class ComparisonRow:
    """One clip restored by one method at one light level; either a score or the reason why there is none."""

    method: str
    description: str  # of the method, with a digest of its weights
    light: str
    clip: str
    scene: str
    score: metrics.Score | None = None
    seconds_per_frame: float = math.nan
    peak_bytes: int | None = None  # of memory while restoring, beyond what was in use before
    peak: float = math.nan  # photons per pixel that the scores refer to
    truth_psnr: float | None = None  # dB; what a perfect restorer would score against this truth, at least
    motion_pixels: tuple[int, ...] = ()  # per bin of breakdown.EDGES; empty where the clip has no flow
    motion_squares: tuple[float, ...] = ()  # squared error summed over them, matched, in units of the peak
    failure: str | None = None

    @property
    def key(self) -> tuple[str, str, str, str]:
        """What must agree for an old result to count."""
        return self.method, self.description, self.light, self.clip

    def to_dict(self) -> dict[str, Any]:
        """JSON has no NaN and no infinity: they become null."""
        return json_safe(asdict(self))

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> ComparisonRow:
        score = values.pop("score")
        if score is not None:
            numbers: dict[str, Any] = {name: math.nan if v is None else v for name, v in score.items()}
            score = metrics.Score(**numbers)
        seconds, peak = values.pop("seconds_per_frame"), values.pop("peak")
        values |= {name: tuple(values[name]) for name in ("motion_pixels", "motion_squares")}
        values |= {"seconds_per_frame": math.nan if seconds is None else seconds}
        return cls(score=score, peak=math.nan if peak is None else peak, **values)


def json_safe(value: Any) -> Any:
    """The same with null for numbers that JSON cannot hold."""
    if isinstance(value, dict):
        return {name: json_safe(v) for name, v in value.items()}
    if isinstance(value, list | tuple):
        return [json_safe(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def scored_frames(length: int, published: bool) -> range:
    """Frames of a clip that are scored: all, or, as published, those with five frames before and five after."""
    return range(PUBLISHED_EDGE, max(PUBLISHED_EDGE, length - PUBLISHED_EDGE)) if published else range(length)


def scene_of(clip: Clip) -> str:
    """Family and seed: clips of one scene are no independent evidence."""
    scene = clip.meta.get("scene") or {}
    return f"{scene['family']}:{scene.get('seed', 0)}" if "family" in scene else clip.name


def truth_psnr(clip: Clip, factor: float, peak: float, frames: range) -> float | None:
    """PSNR [dB] of the clip's own truth at a peak in photons, from its measured errors; None if there are none.

    At least so much. Errors that were measured clamped at white serve peaks up to 2.5 times the mean light. At another
    peak, and for clips of earlier versions, an unclamped error counts as if all of it lay below the peak. Errors are
    measured in radiance; photons are proportional to it.
    """
    errors = clip.meta.get("error_per_frame")
    if not errors or clip.mean_radiance <= 0:
        return None
    if peak <= peak_of(mean_light(clip, factor), None) * (1 + 1e-6):
        errors = clip.meta.get("error_at_white_per_frame", errors)
    unit = mean_light(clip, factor) / clip.mean_radiance / peak
    return metrics.truth_psnr([errors[t] * unit for t in frames])


def peak_in_photons(comparison: Comparison, clip: Clip, codes: Codes, factor: float) -> float:
    """The peak of a clip's scores: as the comparison says, else 2.5 times the mean light, or as published the white."""
    if comparison.peak is None and comparison.published:
        return codes.white
    return peak_of(mean_light(clip, factor), comparison.peak)


def restore_clip(
    method: Restorer,
    clip: Clip,
    light: Illumination,
    comparison: Comparison,
    codes: Codes,
    factor: float,
    out: Path | None = None,
) -> ComparisonRow:
    """Restore and score one clip, and keep a crop of its middle frame under OUT; a failure becomes the row's reason."""
    row = ComparisonRow(method.name, method.description, comparison.stream or light.label, clip.name, scene_of(clip))
    frames = scored_frames(len(clip), comparison.published)
    white = peak_in_photons(comparison, clip, codes, factor)
    target, valid = truth(clip, factor, frames.start, frames.stop) / white, known(clip, frames.start, frames.stop)
    windows = list(windows_sensed(clip, light, comparison.seed, frames)) if comparison.published else []
    before, started = reset_peak(), time.perf_counter()
    try:
        if comparison.published:
            pieces = [method.restore(window, PUBLISHED_EDGE, PUBLISHED_EDGE + 1) for window in windows]
            restored = np.concatenate(pieces)
        else:
            restored = method.restore(codes)
        seconds = (time.perf_counter() - started) / len(frames)
        peak = peak_memory() - before
        score = metrics.score(restored / np.float32(white), target, per_frame_scale=comparison.published, valid=valid)
    except Exception as error:  # whatever a method dies of is its result
        return replace(row, failure=f"{type(error).__name__}: {' '.join(str(error).split())}")
    matched = restored * np.float32(score.scale / white)
    speed = breakdown.speeds(clip, frames)
    if speed is not None and valid is not None:
        speed = np.where(valid, speed, math.nan)
    pixels, squares = ((), ()) if speed is None else breakdown.by_motion(matched, target, speed)
    if out is not None:
        keep_crops(out, row, clip, codes, frames, {row.method: matched, "truth": target})
    return replace(
        row,
        score=score,
        seconds_per_frame=seconds,
        peak_bytes=peak,
        peak=white,
        truth_psnr=truth_psnr(clip, factor, white, frames),
        motion_pixels=pixels,
        motion_squares=squares,
    )


def keep_crops(
    out: Path, row: ComparisonRow, clip: Clip, codes: Codes, frames: range, stacks: dict[str, Array]
) -> None:
    """The part of the middle frame where most moves, from each [T, H, W] stack and from the codes, under OUT/crops."""
    middle = len(frames) // 2
    part = breakdown.place(clip, frames[middle])
    pictures = {name: stack[middle][part] for name, stack in stacks.items()}
    pictures["codes"] = codes.read(frames[middle], frames[middle] + 1)[0][part] / (codes.sensor.levels - 1)
    for name, picture in pictures.items():
        breakdown.save_crop(breakdown.crop_file(out, row.light, row.clip, name), picture)


def evaluate(
    comparison: Comparison,
    methods: Sequence[Restorer],
    out: Path | None = None,
    progress: ComparisonProgress | None = None,
) -> list[ComparisonRow]:
    """Every method on every clip at every light level; rows are kept in OUT/rows.jsonl and taken from there.

    ValueError if there is nothing to score, FileExistsError if OUT holds another evaluation.
    """
    if comparison.stream is not None and (comparison.published or len(comparison.lights) > 1):
        raise ValueError("a stored stream has one light level and one exposure; leave out --ppp and --published")
    clips = open_clips(comparison.source, comparison.split)
    if not clips:
        raise ValueError(f"{comparison.source}: no finished clip in split {comparison.split!r}")
    for clip in clips:
        if not scored_frames(len(clip), comparison.published):
            raise ValueError(f"clip {clip.name}: {len(clip)} frames are too few, the published windows have 11")
    known = {row.key: row for row in begin(comparison, out, clips)} if out is not None else {}
    rows: list[ComparisonRow] = []
    total = len(comparison.lights) * len(clips) * len(methods)
    for light in comparison.lights:
        for clip in clips:
            drawn, factor = (
                sensed(clip, light, comparison.seed) if comparison.stream is None else stored(clip, comparison.stream)
            )
            label = comparison.stream or light.label
            codes: Codes | None = None
            for method in methods:
                key = (method.name, method.description, label, clip.name)
                if progress is not None:
                    progress(f"{method.name}, {clip.name}, {label}", len(rows), total)
                if key not in known:
                    codes = codes or in_memory(drawn)
                    known[key] = restore_clip(method, clip, light, comparison, codes, factor, out)
                    if out is not None:
                        append(out / "rows.jsonl", known[key])
                rows.append(known[key])
    if progress is not None:
        progress("done", total, total)
    return rows


def streams(comparison: Comparison) -> Iterator[Codes]:
    """Every stream of a comparison, nothing drawn yet; as `evaluate` for what cannot be scored."""
    for light in comparison.lights:
        for clip in open_clips(comparison.source, comparison.split):
            yield (
                sensed(clip, light, comparison.seed) if comparison.stream is None else stored(clip, comparison.stream)
            )[0]


def in_memory(codes: Codes) -> Codes:
    """The same, drawn once for all methods."""
    return replace(codes, read=array_codes(codes.read(0, codes.shape[0]), codes.sensor, codes.exposure).read)


def content_digest(comparison: Comparison, clips: Sequence[Clip]) -> str:
    """SHA-256 of what is scored: the descriptions of the clips, which hold checksums, and of the stored stream."""
    described = [
        [clip.meta, None if comparison.stream is None else clip.stream(comparison.stream).meta] for clip in clips
    ]
    return hashlib.sha256(json.dumps(described, sort_keys=True, default=str).encode()).hexdigest()


def begin(comparison: Comparison, out: Path, clips: Sequence[Clip]) -> list[ComparisonRow]:
    """Make the folder of an evaluation, or take the finished rows of an interrupted one of the same content."""
    path = out / "plan.json"
    wanted = {"format": PLAN_FORMAT} | comparison.to_dict() | {"content_sha256": content_digest(comparison, clips)}
    if not path.exists():
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise FileExistsError(f"{out} exists and is no evaluation; choose another -o")
        out.mkdir(parents=True, exist_ok=True)
        write_json(path, wanted)
    elif (found := read_json(path)) != wanted:
        same = {key: value for key, value in found.items() if key != "content_sha256"}
        changed = {"content_sha256": wanted["content_sha256"]} | same == wanted
        what = "rows of clips or streams that were changed since" if changed else "another evaluation"
        raise FileExistsError(f"{out} holds {what}; choose another -o, or start again with --force")
    rows = out / "rows.jsonl"
    if not rows.exists():
        return []
    text = rows.read_text()
    if not text.endswith("\n"):  # a killed writer tore its last line: close it, so that the next one stands alone
        with open(rows, "a", encoding="utf-8") as file:
            file.write("\n")
    return list(finished(text.splitlines()))


def finished(lines: Sequence[str]) -> Iterator[ComparisonRow]:
    """Rows of a file whose last line may be torn; failures are left out, so that they are tried again."""
    for line in lines:
        try:
            row = ComparisonRow.from_dict(json.loads(line))
        except (json.JSONDecodeError, KeyError, TypeError):
            continue
        if row.failure is None:
            yield row


def append(path: Path, row: ComparisonRow) -> None:
    with open(path, "a", encoding="utf-8") as file:
        file.write(json.dumps(row.to_dict(), sort_keys=True, allow_nan=False) + "\n")
        file.flush()
        os.fsync(file.fileno())
