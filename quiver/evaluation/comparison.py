"""Compares methods: scores on held-out clips at several light levels, with the PSNR of the ground truth itself.

    clips x lights -> codes (fixed keys) -> restored -> Score per clip -> mean and 95 % interval over scenes

All methods receive the same codes of the same frames. Every result is stored at once, so an interrupted evaluation
resumes. A method that fails keeps its row, with the reason. Tables and figures: summary.py. Real photons of a static
object: static_object.py.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim import records, scratch
from qsim.files import Blocked, read_json, write_json
from quiver import threads
from quiver.data.clips import Clip, open_clips, peak_of
from quiver.data.codes import Codes, CodeTruth, Stream, array_codes, check_published, sensed, stored, windows_sensed
from quiver.data.illumination import Illumination, file_digests, labels, read_sensor
from quiver.device import PeakMemory
from quiver.evaluation import breakdown, metrics
from quiver.evaluation.comparison_rows import ComparisonRow, append, stored_rows
from quiver.host import own_numbers
from quiver.restoration.interface import Restorer
from quiver.restoration.networks import settings_of

FORMAT = "quiver-evaluation-2"  # 1: peak = the sensor's white, factor of the least unclamped error
PLAN_FORMAT = "quiver-plan-2"
CLIPS = "clips"  # folder in an evaluation that holds the imported clips of a test set
LOCK = "lock"  # file in an evaluation that `quiver evaluate` holds while it works there
PUBLISHED_EDGE = 5  # frames at each end that the published evaluation leaves out

ComparisonProgress = Callable[[str, int, int], None]  # (text for people, rows done, rows in all)


@dataclass(frozen=True)
class Comparison:
    """The settings of an evaluation; stored beside the results."""

    source: str  # data set or clip folder
    split: str | None = "test"  # None = all clips
    lights: tuple[Illumination, ...] = (Illumination(),)
    seed: int = 0  # of the test noise: the same for all methods and all runs
    published: bool = False  # every window exposed, drawn, scaled and scored separately; ends of clips left out
    stream: str | None = None  # score this stored stream instead of sensing at `lights`
    peak: float | None = None  # of the scores, photons per pixel; None = 2.5 x mean light (published: sensor's white)
    test_set: str | None = None  # of the paper, in its own layout: the truth is grey / 255, its peak 1
    planes: int | None = None  # of the stored stream, which are summed to a code; None = its codes as they are

    def __post_init__(self) -> None:
        labels(self.lights)  # `ValueError` where two would have one name

    def label(self, light: Illumination) -> str:
        """Return the text of tables of one of the lights, or of the stored stream."""
        if self.stream is not None:
            return self.stream if self.planes is None else f"{self.stream}, {self.planes} planes"
        return labels(self.lights)[light]

    def to_dict(self) -> dict[str, object]:
        """Return plain values, for JSON."""
        plain: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        return {name: v for name, v in plain.items() if v is not None or name not in ("test_set", "planes")}


def scored_frames(length: int, published: bool) -> range:
    """Return the scored frames of a clip: all, or, as published, those with five frames before and five after."""
    return range(PUBLISHED_EDGE, max(PUBLISHED_EDGE, length - PUBLISHED_EDGE)) if published else range(length)


def scene_of(clip: Clip) -> str:
    """Return family and seed: clips of one scene are not independent evidence."""
    scene = clip.info.scene
    return clip.name if scene is None else f"{scene.family}:{scene.seed}"


def clips_of(comparison: Comparison) -> Sequence[Clip]:
    """Return the scored clips: of a data set, or the imported ones of a test set of the paper."""
    if comparison.test_set is None:
        return open_clips(comparison.source, comparison.split)
    return [Clip.open(path) for path in sorted(Path(comparison.source).iterdir()) if (path / "clip.json").exists()]


def truth_psnr(truth: CodeTruth, peak: float, codes: range) -> float | None:
    """Return the PSNR [dB] of the truth of codes at a peak in photons, from its measured errors; None without them.

    It is a lower bound. Errors that were measured clamped at white apply to peaks up to 2.5 times the mean light. At
    another peak an unclamped error counts as if all of it lay below the peak.
    Errors are measured in radiance, to which photons are proportional.
    """
    clip = truth.clip
    info = clip.info
    errors = (info.error_per_frame, info.error_per_code)
    if not info.error_per_frame or clip.mean_radiance <= 0:
        return None
    if info.error_at_white_per_frame and peak <= peak_of(truth.mean_light, None) * (1 + 1e-6):
        errors = (info.error_at_white_per_frame, info.error_at_white_per_code)
    planes = 1 if info.render is None else info.render.planes
    unit = truth.mean_light / clip.mean_radiance / peak
    middles = [truth.exposures.middle_frame(t) for t in codes]
    return metrics.truth_psnr([_error_of_middle(*errors, middle, planes) * unit for middle in middles])


def _error_of_middle(per_frame: Sequence[float], per_code: Sequence[float], middle: int, planes: int) -> float:
    """Return the error of the sharp frame of a code: of planes that share noise, the middle has samples of its own."""
    if per_code and middle % planes == planes // 2:
        return per_code[middle // planes]
    return per_frame[middle]


@own_numbers
def score_video(video: Array, stream: Stream, *, peak: float | None = None) -> metrics.Score:
    """Return the score of restored video, [T, H, W] or [T, 3, H, W], in photons against the truth of its stream.

    `peak` [photons per pixel] is the light that the decibels refer to: 2.5 times the mean light of the stream by
    default, as in `quiver evaluate`. Pixels whose light is not known do not count. `ValueError` for another shape,
    `FileNotFoundError` for a stream without a clip.
    """
    frames, height, width = stream.shape
    expected = stream.shape if stream.colour_filter is None else (frames, 3, height, width)
    if np.shape(video) != expected:
        raise ValueError(f"video has shape {list(np.shape(video))}, stream {list(expected)}; they must be equal")
    target = stream.truth()
    white = peak_of(target.mean() if stream.info.light is None else stream.info.light.ppp, peak)
    return metrics.score(np.asarray(video) / np.float32(white), target / white, valid=stream.known())


def peak_in_photons(comparison: Comparison, codes: Codes, truth: CodeTruth) -> float:
    """Return the peak of a clip's scores: as set, else 2.5 times the mean light, or as published the white.

    Of the paper's test sets it is the light of grey 255.
    """
    if comparison.test_set is not None:
        return truth.factor
    if comparison.peak is None and comparison.published:
        return codes.white
    return peak_of(truth.mean_light, comparison.peak)


def restore_clip(
    method: Restorer,
    clip: Clip,
    light: Illumination,
    comparison: Comparison,
    codes: Codes,
    truth: CodeTruth,
    out: Path | None = None,
) -> ComparisonRow:
    """Restore and score one clip, and store a crop of its middle code under OUT.

    A failure becomes the reason in the row.
    """
    name = comparison.label(light)
    precision, cut = settings_of(method, codes)
    row = ComparisonRow(method.name, method.description, name, clip.name, scene_of(clip), precision=precision, cut=cut)
    row = replace(row, device=method.device, threads=threads.current())
    frames = scored_frames(len(truth), comparison.published)
    white = peak_in_photons(comparison, codes, truth)
    target = truth.video(frames.start, frames.stop) / white
    valid = truth.known(frames.start, frames.stop)
    windows = list(windows_sensed(clip, light, comparison.seed, frames)) if comparison.published else []
    memory = PeakMemory(method.device)
    started = time.perf_counter()
    try:
        if comparison.published:
            restored = np.concatenate([method.restore(one, PUBLISHED_EDGE, PUBLISHED_EDGE + 1) for one in windows])
        else:
            restored = method.restore(codes)
        seconds = (time.perf_counter() - started) / len(frames)
        peak = memory.bytes()
        unit = codes.white if comparison.test_set else white  # networks learn photons / white, the target is grey / 255
        score, factors = metrics.score_and_factors(
            restored / np.float32(unit), target, per_frame_scale=comparison.published, valid=valid
        )
    except Exception as error:  # a method's failure is recorded as its result
        return replace(row, failure=f"{type(error).__name__}: {' '.join(str(error).split())}")
    matched = restored * (factors / unit).astype(np.float32).reshape(-1, *(1,) * (restored.ndim - 1))
    speed = breakdown.speeds(truth, frames)
    if speed is not None and valid is not None:
        speed = np.where(valid, speed, math.nan)
    pixels, squares = ((), ()) if speed is None else breakdown.by_motion(matched, target, speed)
    if out is not None:
        shown = replace(codes, read=_middles(windows, frames)) if windows else codes
        breakdown.keep_crops(out, row.light, truth, shown, frames, {row.crop: matched, "truth": target})
    return replace(
        row,
        score=score,
        seconds_per_frame=seconds,
        peak_bytes=peak,
        peak=white,
        truth_psnr=truth_psnr(truth, white, frames),
        motion_pixels=pixels,
        motion_squares=squares,
    )


def _middles(windows: Sequence[Codes], frames: range) -> Callable[[int, int], Array]:
    """Return the reader of the middle codes of windows, each of which restores one of the frames."""

    def read(start: int, stop: int) -> Array:
        chosen = windows[start - frames.start : stop - frames.start]
        return np.concatenate([window.read(PUBLISHED_EDGE, PUBLISHED_EDGE + 1) for window in chosen])

    return read


def check(comparison: Comparison) -> list[Clip]:
    """Return the scored clips; `ValueError` if there are none, or if they or the lights do not fit the settings."""
    if comparison.stream is not None and (comparison.published or len(comparison.lights) > 1):
        raise ValueError("a stored stream has one light level and one exposure; leave out ppp= and published=True")
    clips = list(clips_of(comparison))
    if not clips:
        raise ValueError(f"{comparison.source}: no finished clip in split {comparison.split!r}")
    names = [clip.name for clip in clips]
    if twice := [name for name in dict.fromkeys(names) if names.count(name) > 1]:
        raise ValueError(
            f"{comparison.source}: two clips are called {twice[0]}, by which rows are kept; make one of them again "
            "under another name"
        )
    for clip in clips:
        if comparison.published:
            clip.require_one_band("the published protocol")
        if not scored_frames(len(clip), comparison.published):
            raise ValueError(f"clip {clip.name}: {len(clip)} frames are too few; published windows have 11")
    for light in comparison.lights if comparison.published else ():
        check_published(light)
        if light.sensor.endswith(".toml") and read_sensor(light.sensor, light.bits)[1]:
            raise ValueError(
                f"published=True: draws windows without defects, and {light.sensor} has a table [defects]; leave it out"
            )
        if light.draw(clips[0]).remembers:
            raise ValueError(
                f"published=True: draws windows one by one, and the charge of a spike camera ({light.sensor}) stays "
                "between them; leave it out"
            )
    return clips


def evaluate(
    comparison: Comparison,
    methods: Sequence[Restorer],
    out: Path | None = None,
    progress: ComparisonProgress | None = None,
) -> list[ComparisonRow]:
    """Run every method on every clip at every light level; rows are stored in OUT/rows.jsonl and reused from there.

    `ValueError` if there is nothing to score, `FileExistsError` if OUT holds another evaluation.
    """
    clips = check(comparison)
    known = {row.key: row for row in begin(comparison, out, clips)} if out is not None else {}
    rows: list[ComparisonRow] = []
    total = len(comparison.lights) * len(clips) * len(methods)
    for light in comparison.lights:
        for clip in clips:
            drawn, truth = _codes(comparison, clip, light)
            label = comparison.label(light)
            codes: Codes | None = None
            for method in methods:
                precision, cut = settings_of(method, drawn)
                key = (method.name, method.description, label, clip.name, precision, cut)
                if progress is not None:
                    progress(f"{method.name}, {clip.name}, {label}", len(rows), total)
                if key not in known:
                    codes = codes or in_memory(drawn)
                    known[key] = restore_clip(method, clip, light, comparison, codes, truth, out)
                    if out is not None:
                        append(out / "rows.jsonl", known[key])
                rows.append(known[key])
    if progress is not None:
        progress("done", total, total)
    return rows


def streams(comparison: Comparison) -> Iterator[Codes]:
    """Yield every stream of a comparison before anything is drawn; errors as `evaluate`."""
    for light in comparison.lights:
        for clip in clips_of(comparison):
            yield _codes(comparison, clip, light)[0]


def _codes(comparison: Comparison, clip: Clip, light: Illumination) -> tuple[Codes, CodeTruth]:
    """Return the scored codes of a clip and their truth."""
    if comparison.stream is None:
        return sensed(clip, light, comparison.seed)
    return stored(clip, comparison.stream, comparison.planes)


def in_memory(codes: Codes) -> Codes:
    """Return the same codes, drawn once for all methods."""
    return replace(codes, read=array_codes(codes.read(0, codes.shape[0]), codes.sensor, codes.exposure).read)


def content_of(comparison: Comparison, clips: Sequence[Clip]) -> dict[str, object]:
    """Return the SHA-256 of the scored content: the descriptions of clips and stored stream, and the sensor files."""
    name = comparison.stream
    # Descriptions hold the checksums of all files, so that their digest stands for the whole content.
    described = [
        [records.plain(clip.info), None if name is None else records.plain(clip.stream(name).info)] for clip in clips
    ]
    found = {"content_sha256": hashlib.sha256(json.dumps(described, sort_keys=True, default=str).encode()).hexdigest()}
    files = file_digests(comparison.lights)
    return found | ({"sensors_sha256": files} if files else {})


def check_folder(out: Path, comparison: Comparison, *, force: bool = False) -> None:
    """Raise `FileExistsError` if OUT is neither an evaluation nor empty but for its lock and imported clips.

    With `force` the error says that such a folder is not removed.
    """
    if (out / "plan.json").is_file() or not out.exists():
        return
    allowed = {LOCK, CLIPS} if comparison.test_set else {LOCK}
    if out.is_dir() and all(path.name in allowed for path in out.iterdir()):
        return
    if force:
        raise FileExistsError(f"{out} holds no plan.json; only what this program made is removed")
    raise FileExistsError(f"{out} exists and is not an evaluation; choose another")


def begin(comparison: Comparison, out: Path, clips: Sequence[Clip]) -> list[ComparisonRow]:
    """Create the folder of an evaluation, or return the finished rows of an interrupted one of the same content."""
    path = out / "plan.json"
    scratch.sweep(out / "crops")
    content = content_of(comparison, clips)
    wanted = {"format": PLAN_FORMAT} | comparison.to_dict() | content
    if not path.exists():
        check_folder(out, comparison)
        out.mkdir(parents=True, exist_ok=True)
        write_json(path, wanted)
    elif (found := read_json(path)) != wanted:
        changed = found | content == wanted
        what = "rows of clips, streams or sensors that were changed since" if changed else "another evaluation"
        raise Blocked(f"{out} holds {what}", "choose another folder, or start again with force=True")
    return stored_rows(out / "rows.jsonl")
