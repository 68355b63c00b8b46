"""Summarises an evaluation: means with 95 % intervals over scenes, per scene, as Markdown and as a figure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from qsim.figures import new_figure, write_figure
from qsim.files import write_bytes, write_json
from qsim.tables import markdown_table
from quiver.evaluation import breakdown, metrics
from quiver.evaluation.comparison import FORMAT, PUBLISHED_EDGE, Comparison, ComparisonRow
from quiver.evaluation.json_values import json_safe
from quiver.evaluation.metrics import Interval, over_scenes
from quiver.restoration.interface import Restorer

COLUMNS = (
    "method",
    "frames (future)",
    "light",
    "PSNR",
    "PSNR matched",
    "by frames",
    "SSIM",
    "SSIM matched",
    "factor",
    "s/frame",
    "memory",
    "above peak",
    "noise floor",
)
MEMORY = (
    "Memory: the largest increase while one clip was restored. Memory that an earlier method left free is not counted; "
    "`quiver bench` measures each method in a separate process. Of a network on a GPU: the largest memory allocated "
    "there, with the weights of all networks of the table."
)
SCORES = ("psnr", "psnr_matched", "ssim", "ssim_matched")


@dataclass(frozen=True)
class SummaryLine:
    """One line of the table: a method at one light level."""

    method: str
    light: str
    scores: dict[str, Interval]  # over scenes
    psnr_matched_per_frame: float  # dB, mean over all frames of all clips alike
    scale: float  # best factor, mean over clips
    scale_spread: float  # standard deviation over clips, or over windows where every window has its own
    psnr_by_motion: list[float]  # dB, matched, all pixels of a bin of breakdown.EDGES pooled; NaN = no pixel
    seconds_per_frame: float  # NaN where devices or threads differ
    peak_bytes: int | None  # of memory, largest over clips; None where devices or threads differ
    devices: tuple[str, ...]  # where the clips were restored
    threads: tuple[int | None, ...]  # of torch
    above_peak: float  # share of target pixels above the peak, largest over clips
    truth_psnr: float | None  # dB, mean over clips
    near_truth: tuple[str, ...]  # PSNR scores within metrics.NEAR_TRUTH of that of the truth, in some clip
    failures: tuple[str, ...]  # clip: reason


def mean(values: Sequence[float]) -> float:
    """Return the mean of values; NaN without any."""
    return sum(values) / len(values) if values else math.nan


def summarise(rows: Sequence[ComparisonRow]) -> list[SummaryLine]:
    """Return one line per method and light level, in the order of the rows."""
    groups: dict[tuple[str, str], list[ComparisonRow]] = {}
    for row in rows:
        groups.setdefault((row.light, row.method), []).append(row)
    return [_line(method, light, group) for (light, method), group in groups.items()]


def _line(method: str, light: str, rows: Sequence[ComparisonRow]) -> SummaryLine:
    good = [(row, row.score) for row in rows if row.score is not None]
    scales = [score.scale for _, score in good]
    spread = math.sqrt(mean([(s - mean(scales)) ** 2 for s in scales])) if good else math.nan
    within = mean([score.scale_spread for _, score in good])
    frames = sum(score.frames for _, score in good)
    moved = [row for row, _ in good if row.motion_pixels]
    by_frames = [(s.psnr_matched, s.frames) for _, s in good if s.frames]
    truths = [row.truth_psnr for row, _ in good if row.truth_psnr is not None]
    devices = tuple(dict.fromkeys(row.device for row, _ in good))
    threads = tuple(dict.fromkeys(row.threads for row, _ in good))
    alike = [row for row, _ in good if len(devices) == len(threads) == 1]
    return SummaryLine(
        method=method,
        light=light,
        scores={name: over_scenes([getattr(s, name) for _, s in good], [r.scene for r, _ in good]) for name in SCORES},
        psnr_matched_per_frame=sum(psnr * n for psnr, n in by_frames) / frames if frames else math.nan,
        scale=mean(scales),
        scale_spread=within if within > 0 else spread,
        psnr_by_motion=breakdown.pooled([row.motion_pixels for row in moved], [row.motion_squares for row in moved]),
        seconds_per_frame=mean([row.seconds_per_frame for row in alike]),
        peak_bytes=max((row.peak_bytes for row in alike if row.peak_bytes is not None), default=None),
        devices=devices,
        threads=threads,
        above_peak=max((score.above_peak for _, score in good), default=math.nan),
        truth_psnr=mean(truths) if truths else None,
        near_truth=tuple(name for name in SCORES[:2] if any(near_truth(row, name) for row, _ in good)),
        failures=tuple(f"{row.clip}: {row.failure}" for row in rows if row.failure is not None),
    )


def near_truth(row: ComparisonRow, name: str = "psnr_matched") -> bool:
    """Return whether the PSNR of a clip is so close to that of its truth that the error of the truth matters."""
    if row.score is None or row.truth_psnr is None:
        return False
    return bool(getattr(row.score, name) > row.truth_psnr - metrics.NEAR_TRUTH)


def _number(value: float, digits: int) -> str:
    return "n/a" if math.isnan(value) else f"{value:.{digits}f}"


def _interval(found: Interval, digits: int) -> str:
    text = _number(found.mean, digits)
    return text if math.isnan(found.half_width) else f"{text} ± {found.half_width:.{digits}f}"


def markdown(
    comparison: Comparison, methods: Sequence[Restorer], rows: Sequence[ComparisonRow], remarks: Sequence[str] = ()
) -> str:
    """Return the complete evaluation as Markdown: means, caveats, failures and scores per scene.

    `remarks` are lines about what was scored, and about networks outside of what they were measured for.
    """
    by_name = {method.name: method for method in methods}
    count = len({row.clip for row in rows})
    text = [
        f"# Evaluation of {comparison.source}, split {comparison.split or 'all'}, {count} clip{'s' * (count != 1)}",
        "",
        f"{_seen_by(comparison)}{'' if comparison.stream else f', noise seed {comparison.seed}'}; "
        + (
            "published protocol: every window exposed, scaled and scored on its own"
            if comparison.published
            else "all frames"
        )
        + "; mean ± half-width of the 95 % interval over scenes (clips of one scene averaged first"
        + ("; there is only one, hence no interval" if len({row.scene for row in rows}) == 1 else "")
        + ("; clips that state no scene count as one each" if any(row.scene == row.clip for row in rows) else "")
        + f"). PSNR in dB, peak = {peak_name(comparison)}; output and truth end at the peak. "
        + "Matched = after the one factor "
        + ("per window" if comparison.published else "per clip")
        + " that is best behind this clamp; by frames = its mean over all frames of all clips alike; above peak = "
        "share of the truth's pixels; noise floor = PSNR of the ground truth itself; n/a = the clamp hides the "
        "complete error, or no window of SSIM fits.",
        "",
    ]
    lines = summarise(rows)
    text += markdown_table([_cells(line, by_name[line.method], comparison.published) for line in lines], COLUMNS)
    text += ["", *_caveats(lines, rows), *[f"{remark}\n" for remark in remarks]]
    text += [MEMORY, "", *_mixed(lines)]
    failures = [f"- {line.method}, {line.light}, {reason}" for line in lines for reason in line.failures]
    text += ["## Failures", "", *failures, ""] if failures else []
    return "\n".join([*text, *_by_motion(lines), *_per_scene(rows)]) + "\n"


def peak_name(comparison: Comparison) -> str:
    """Return the name of the peak that the scores of a comparison refer to."""
    if comparison.peak is not None:
        return f"{comparison.peak:g} photons per pixel"
    if comparison.test_set is not None:
        return "grey 255, as published"
    return "the sensor's white, as published" if comparison.published else "2.5 x the stream's mean light"


def frames_of(method: Restorer, *, published: bool) -> tuple[int | None, int]:
    """Return how many frames a restored one takes, None for all earlier ones, and how many of them are future ones.

    A published window holds PUBLISHED_EDGE frames on each side.
    """
    future = method.look_ahead
    if published:
        past = min(method.window - 1 - future, PUBLISHED_EDGE)
        future = min(future, PUBLISHED_EDGE)
        return past + 1 + future, future
    return method.frames_used if method.seamless else None, future


def _cells(line: SummaryLine, method: Restorer, published: bool) -> list[str]:
    count, future = frames_of(method, published=published)
    cells = [line.method, f"{'all earlier' if count is None else count} ({future})", line.light]
    if line.failures and line.scores["psnr"].scenes == 0:
        cells += [f"failed: {line.failures[0]}", *[""] * 9]
    else:
        scores = [
            _interval(line.scores[name], 2 if "psnr" in name else 3) + (" †" if name in line.near_truth else "")
            for name in SCORES
        ]
        cells += [*scores[:2], _number(line.psnr_matched_per_frame, 2), *scores[2:]]
        cells += [f"{line.scale:.3f} (spread {line.scale_spread:.3f})"]
        cells += ["-" if math.isnan(line.seconds_per_frame) else f"{line.seconds_per_frame:.3g}"]
        cells += ["-" if line.peak_bytes is None else f"{line.peak_bytes / 1e6:.0f} MB"]
        cells += [f"{100 * line.above_peak:.1f} %"]
        cells += ["not measured" if line.truth_psnr is None else f"{line.truth_psnr:.1f}"]
    return cells


def _caveats(lines: Sequence[SummaryLine], rows: Sequence[ComparisonRow]) -> list[str]:
    """Return what weakens the scores: truth above the peak, and truth hardly better than the answer."""
    over: dict[str, tuple[float, str]] = {}
    for row in rows:
        if row.score is not None and row.score.above_peak > max(metrics.ABOVE_PEAK, over.get(row.light, (0.0, ""))[0]):
            over[row.light] = row.score.above_peak, f"{row.clip} at {row.light}"
    text = [metrics.above_peak_warning(what, share) + "\n" for share, what in over.values()]
    if any(line.near_truth for line in lines):
        text.append(
            f"† In one clip or more within {metrics.NEAR_TRUTH:g} dB of the noise floor of the ground truth: the "
            "error of the truth is a large part of this score.\n"
        )
    return text


def _mixed(lines: Sequence[SummaryLine]) -> list[str]:
    """Return a note on the lines whose clips were restored on several devices or by several numbers of threads."""
    told = []
    for line in lines:
        if max(len(line.devices), len(line.threads)) > 1:
            devices = ", ".join(line.devices)
            threads = ", ".join(str(count) for count in line.threads)
            told.append(f"{line.method}, {line.light} (devices: {devices}; threads: {threads})")
    return [f"No time and memory, because not all clips were restored alike: {'; '.join(told)}.", ""] if told else []


def _seen_by(comparison: Comparison) -> str:
    sensors = dict.fromkeys(light.sensor for light in comparison.lights)
    return f"Stream {comparison.stream}" if comparison.stream is not None else f"Sensor {', '.join(sensors)}"


def _by_motion(lines: Sequence[SummaryLine]) -> list[str]:
    """Return the table of PSNR against motion; nothing if no clip has flow."""
    moving = [line for line in lines if not all(math.isnan(psnr) for psnr in line.psnr_by_motion)]
    if not moving:
        return []
    text = ["## By motion: matched PSNR in dB of all pixels that move so many px/frame", ""]
    cells = [
        [line.method, line.light, *("-" if math.isnan(psnr) else f"{psnr:.2f}" for psnr in line.psnr_by_motion)]
        for line in moving
    ]
    return [*text, *markdown_table(cells, ["method", "light", *breakdown.bin_names()]), ""]


def _per_scene(rows: Sequence[ComparisonRow]) -> list[str]:
    methods = list(dict.fromkeys(row.method for row in rows))
    table = []
    for scene, light in dict.fromkeys((row.scene, row.light) for row in rows):
        cells = []
        for method in methods:
            chosen = [row for row in rows if (row.scene, row.light, row.method) == (scene, light, method)]
            found = [row.score.psnr_matched for row in chosen if row.score is not None]
            cells.append(_number(mean(found), 2) + (" †" if any(near_truth(row) for row in chosen) else ""))
        table.append([scene, light, *cells])
    return ["## Per scene: matched PSNR in dB", "", *markdown_table(table, ["scene", "light", *methods])]


def as_dict(
    comparison: Comparison, methods: Sequence[Restorer], rows: Sequence[ComparisonRow], remarks: Sequence[str] = ()
) -> dict[str, object]:
    """Return the complete evaluation for programs."""
    found: dict[str, Any] = json_safe(
        {
            "format": FORMAT,
            "plan": comparison.to_dict(),
            "peak": peak_name(comparison),
            "remarks": list(remarks),
            "methods": [
                {
                    "name": m.name,
                    **dict(zip(("frames", "future"), frames_of(m, published=comparison.published), strict=True)),
                    "learned": m.learned,
                    "is": m.description,
                }
                for m in methods
            ],
            "table": [json_safe(asdict(line), infinite=True) for line in summarise(rows)],
            "rows": [json_safe(asdict(row), infinite=True) for row in rows],
        }
    )
    return found


def figure(rows: Sequence[ComparisonRow], path: Path) -> None:
    """Draw the matched PSNR of each method with its interval, one group of bars per light level, as PNG."""
    lines = [line for line in summarise(rows) if line.scores["psnr"].scenes]
    lights = list(dict.fromkeys(x.light for x in lines))
    methods = list(dict.fromkeys(x.method for x in lines))
    drawing = new_figure(4 + 1.2 * max(3, len(lights) * len(methods) / 2), 4)
    axes = drawing.subplots()
    width = 0.8 / max(1, len(methods))
    for i, method in enumerate(methods):
        own = {line.light: line.scores["psnr_matched"] for line in lines if line.method == method}
        places = [lights.index(light) + (i - (len(methods) - 1) / 2) * width for light in own]
        error = [x.half_width for x in own.values()]  # NaN, of one scene, draws none
        look: dict[str, Any] = {"color": f"C{i % 10}", "hatch": ("", "///", "...")[i // 10 % 3], "edgecolor": "white"}
        axes.bar(places, [x.mean for x in own.values()], width, yerr=error, capsize=3, label=method, **look)
    axes.set_xticks(range(len(lights)), lights)
    axes.set_ylabel("PSNR after the best factor [dB]")
    if methods:
        drawing.legend(fontsize="small", loc="outside right upper")
    write_figure(drawing, path)


def write(
    out: Path,
    comparison: Comparison,
    methods: Sequence[Restorer],
    rows: Sequence[ComparisonRow],
    remarks: Sequence[str] = (),
) -> None:
    """Write evaluation.json, .md, .png and one sheet of crops per light level, crops_LIGHT.png, in an evaluation's
    folder.
    """
    one_per_scene = list({row.scene: row.clip for row in reversed(rows)}.values())[::-1]
    for light in dict.fromkeys(row.light for row in rows):
        target = out / f"crops_{light.replace(', ', '_').replace(' ', '').replace('/', '-')}.png"
        crops = {(row.clip, row.method): row.crop for row in rows if row.light == light and row.failure is None}
        breakdown.sheet(out, light, one_per_scene, [method.name for method in methods], crops, target)
    write_bytes(out / "evaluation.md", markdown(comparison, methods, rows, remarks).encode())
    figure(rows, out / "evaluation.png")
    write_json(out / "evaluation.json", as_dict(comparison, methods, rows, remarks))
