"""Builds the sections of a page that hold numbers: training runs, evaluations, studies, validations.

    history.json     -> the learning curve of a training run
    evaluation.json  -> the table of methods; a measured static object likewise; speed against error
    tradeoff.json    -> bit depth against motion; figureN.json -> a figure of the paper; with their stored pictures
    bench.json       -> the cost of a restored frame
    the JSON of `qsim validate` -> speed against error of sensors and rendering; windows read per second

The sections show stored results only; nothing is recomputed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qsim import files, opening
from qsim.report import html as page
from qsim.report import stored_results
from qsim.report.stored_results import EvaluatedMethod, Evaluation, EvaluationPlan, Interval

if TYPE_CHECKING:
    from markupsafe import Markup

NAIVE = "obvious_"  # begins the keys of the naive loop in stored reports
_HEADINGS = {  # of keys whose words alone are unclear
    "answer": "answer",
    "bits": "bits",
    "fps": "frames/s",
    "ppp": "photons per pixel",
    "lux": "faceplate lux at 555 nm",
    "peak": "peak of the PSNR [photons]",
    "frame_rate": "planes/s",
    "motion_px_per_code_frame": "motion [px per 3-bit frame]",
    "blur_error": "blur [photons rms]",
    "blur_over_peak": "blur [of the peak]",
    "blur_predicted": "blur expected [photons rms]",
    "shot_error": "photon noise [photons rms]",
    "quantisation_error": "quantization [photons rms]",
    "read_error": "read noise [photons rms]",
    "snr_db": "SNR [dB]",
    "psnr_db": "PSNR [dB]",
    "psnr_predicted_db": "PSNR expected [dB]",
    "psnr_error_db": "standard error [dB]",
    "sigmas": "difference [standard errors]",
    "psnr_matched": "PSNR matched [dB]",
    "psnr": "PSNR [dB]",
    "stated_psnr": "PSNR stated [dB]",
    "seconds_per_frame": "seconds/frame",
    "peak_bytes": "memory [bytes]",
    "gmac_per_frame": "GMAC/frame",
    "cdf_error": "error of the cdf",
    "p_value": "p of chi-square",
}
_SUFFIXES = (
    ("_megabytes_per_second", " [MB/s]"),
    ("_px_per_frame", " [px/frame]"),
    ("_db", " [dB]"),
    ("_fps", " [1/s]"),
)


def training_section(path: Path) -> page.Section:
    """Return the learning curve: PSNR of the validation clips against minutes, with the weights that were kept."""
    history = stored_results.read(path, stored_results.TrainingHistory)["history"]
    name = path.parent.name
    steps = f"{history[-1]['step']} steps in {history[-1]['elapsed'] / 60:.1f} minutes"
    known = [(entry["elapsed"] / 60, entry["psnr_matched"]) for entry in history if entry["psnr_matched"] is not None]
    if not known:
        story = f"Training in the folder {name} has no finite score on the validation clips."
        return page.section(f"Training: {name}", page.text(f"{steps}; no validation has a finite score."), story=story)
    minutes, scores = zip(*known, strict=True)
    axes, save = page.axes("minutes of training", "validation PSNR, matched [dB]")
    axes.plot(minutes, scores, ".-")
    best = max(range(len(scores)), key=scores.__getitem__)
    last = history[-1]["psnr_matched"]
    axes.plot(minutes[best], scores[best], "o", color="tab:orange", label="best, kept")
    axes.legend()
    reached = f"{scores[best]:.2f} dB on the validation clips after {minutes[best]:.1f} minutes"
    story = f"Training in the folder {name} reached {reached}."
    story += _drop_after(scores[best], last)
    words = f"{steps}. The weights of the best validation are kept ({scores[best]:.2f} dB); the last one has " + (
        "no finite score." if last is None else f"{last:.2f} dB."
    )
    facts = [page.Fact(f"{scores[best]:.2f} dB", f"best validation of {name}")]
    return page.section(f"Training: {name}", save(words), story=story, facts=facts)


def _drop_after(best: float, last: float | None) -> str:
    """Return a sentence if a curve [dB] ends without a score, or below its best in two digits; else nothing."""
    if last is None:
        return " The last validation has no finite score."
    if not last < best - 0.005:
        return ""
    return f" It then got worse: the last validation is {best - last:.2f} dB below the best, whose weights are kept."


def evaluation_section(path: Path) -> page.Section:
    """Return the scores of methods: means and 95 % intervals over scenes, the best matched PSNR of each light bold."""
    found = stored_results.read(path, Evaluation)
    rows = [
        [
            line["method"],
            line["light"],
            _score(line, "psnr", 2) + _near(line, "psnr"),
            _score(line, "psnr_matched", 2) + _near(line, "psnr_matched"),
            _score(line, "ssim_matched", 3),
            page.seconds_text(line["seconds_per_frame"]),
            _percent(line.get("above_peak")),
            line["truth_psnr"],
        ]
        for line in found["table"]
    ]
    lights = [line["light"] for line in found["table"]]
    means = [line["scores"]["psnr_matched"]["mean"] for line in found["table"]]
    failed = [line.get("failures") or [] for line in found["table"]]  # a mean over the other clips is another score
    scores = {i: float(mean) for i, mean in enumerate(means) if mean is not None and not failed[i]}  # "inf" too
    best = {max((i for i in scores if lights[i] == lights[one]), key=scores.__getitem__) for one in scores}
    headers = [
        "method",
        "light",
        "PSNR [dB]",
        "matched [dB]",
        "SSIM matched",
        "time/frame",
        "above peak",
        "noise floor [dB]",
    ]
    caption = (
        f"mean ± half of the 95 % interval over scenes; {_definition(found)}; above peak: share of the truth's pixels; "
        "noise floor: PSNR of the rendered truth itself"
    )
    if any(line.get("near_truth") for line in found["table"]):
        caption += "; † within 3 dB of the noise floor in at least one clip, so the error of the truth is a large part"
    table = page.table(page.Table(caption, headers, rows, frozenset(best)))
    remarks = [page.text(remark) for remark in found.get("remarks", [])]
    remarks += [
        page.text(f"{line['method']} at {line['light']} failed and has no rank: {reason}")
        for line, reasons in zip(found["table"], failed, strict=True)
        for reason in reasons
    ]
    winners = [found["table"][i] for i in sorted(best)]
    facts = [
        page.Fact(
            f"{_pm(line['scores']['psnr_matched'], 1)} dB", f"best matched PSNR, {line['method']} at {line['light']}"
        )
        for line in winners
    ]
    parts = [table, *remarks, _speed_against_error(found)]
    story = _winner(winners, found.get("plan", {}))
    return page.section(f"Methods compared: {path.parent.name}", *parts, story=story, facts=facts)


def _winner(lines: list[EvaluatedMethod], plan: EvaluationPlan) -> str:
    """Return a sentence with the best method of each light level, given their lines; empty without any."""
    if not lines:
        return ""
    best = [f"{_pm(line['scores']['psnr_matched'], 1)} dB by {line['method']} at {line['light']}" for line in lines]
    split = "test" if plan.get("test_set") else plan.get("split")
    kinds = {"train": "training", "val": "held-out", "test": "held-out"}
    start = f"On {kinds[split]} clips the" if split in kinds else "The"
    return f"{start} best matched PSNR is {', '.join(best)}."


def _definition(found: Evaluation) -> str:
    """Return the definition of the scores of an evaluation."""
    unit = "window" if found.get("plan", {}).get("published") else "clip"
    return (
        f"peak = {found['peak']}; matched = after the one factor per {unit} that is best behind the clamp at the peak"
    )


def _near(line: EvaluatedMethod, name: str) -> str:
    return " †" if name in line.get("near_truth", ()) else ""


def _percent(share: object) -> str | None:
    return f"{100 * share:.1f} %" if isinstance(share, int | float) else None


def _score(line: EvaluatedMethod, name: str, digits: int) -> str:
    """Return a score of a line as text; "failed" where no clip has it because the method failed."""
    found = line["scores"][name]
    return "failed" if found["mean"] is None and line.get("failures") else _pm(found, digits)


def _pm(interval: Interval, digits: int) -> str:
    """Return "23.45 ± 0.67", without the half-width if there is one scene; "inf" for the text that stands for it."""
    mean = interval["mean"]
    half = interval["half_width"]
    if mean is None:
        return "n/a"
    return f"{float(mean):.{digits}f}" + (f" ± {half:.{digits}f}" if isinstance(half, int | float) else "")


def static_section(path: Path) -> page.Section:
    """Return the scores on measured photons of a static object: some frames are restored, the others the reference."""
    found = stored_results.read(path, stored_results.StaticObject)
    headers = ["method", "PSNR [dB]", "PSNR matched [dB]", "spread over splits [dB]", "with the reference's noise [dB]"]
    keys = ("method", "psnr", "psnr_matched", "psnr_matched_spread", "psnr_as_measured")
    rows = [[dict(score)[key] for key in keys] for score in found["scores"]]
    caption = (
        f"{Path(found['counts']).name}: real photons clipped to {found['bits']} bits, restored from {found['frames']} "
        "frames, scored against the others; the variance of the reference is subtracted; "
        f"peak = {found['peak']:.4g} photons"
    )
    return page.section("Real photons", page.table(page.Table(caption, headers, rows)))


def _speed_against_error(found: Evaluation) -> Markup | None:
    """Return PSNR against seconds per frame, one mark per method and light level; None if no time is stored."""
    axes, save = page.axes("seconds per frame", "PSNR matched [dB]")
    lights = list(dict.fromkeys(line["light"] for line in found["table"]))
    drawn = 0
    for mark, light in zip("os^vD*Pxd<>" * len(lights), lights, strict=False):
        own = [line for line in found["table"] if line["light"] == light]
        points = [
            (line["seconds_per_frame"], line["scores"]["psnr_matched"]["mean"], line["method"])
            for line in own
            if _is_number(line["seconds_per_frame"]) and _is_number(line["scores"]["psnr_matched"]["mean"])
        ]
        axes.plot([p[0] for p in points], [p[1] for p in points], mark, label=light)
        for seconds, psnr, method in points:
            axes.annotate(method, (seconds, psnr), textcoords="offset points", xytext=(4, 4), fontsize=8)
        drawn += len(points)
    if not drawn:
        return None
    axes.set_xscale("log")
    axes.margins(0.15)  # space for the names
    axes.legend(fontsize=8)
    return save("speed against error: up and to the left is better")


def study_section(path: Path) -> page.Section:
    """Return the rows of a bit-depth study, or the cells of a sweep, with their stored figures."""
    found = files.read_json(path)
    rows = found.get("rows") or found.get("cells") or []
    if path.stem.startswith("figure"):
        rows = [{"clip": row["clip"]} | panel for row in rows for panel in row["panels"]]
    words = {key: value for key, value in found.items() if isinstance(value, int | float | str)}
    keys = list(dict.fromkeys(key for row in rows for key in row if not isinstance(row[key], list | dict)))
    table = page.table(
        page.Table(
            f"{len(rows)} rows", [_heading(key) for key in keys], [[row.get(key) for key in keys] for row in rows]
        )
    )
    lines = [f"{_heading(key)}: {page.number_text(value)}" for key, value in words.items()]
    picture = path.with_name("best.png" if "cells" in found else f"{path.stem}.png")  # of a sweep, or of one study
    name = f"{path.parent.name}/{picture.name}"
    figure = page.stored_figure(opening.content(picture), name) if picture.is_file() else None
    story = next((str(text) for text in (found.get("answer"), *found.get("answers", [])) if text), "")
    return page.section(f"Study: {path.parent.name}", page.bullets(lines), figure, table, story=story)


def bench_section(path: Path) -> page.Section:
    """Return the cost of a restored frame beside its PSNR."""
    found = files.read_json(path)
    keys = list(dict.fromkeys(key for cost in found["costs"] for key in cost if not isinstance(cost[key], list | dict)))
    rows = [[cost.get(key) for key in keys] for cost in found["costs"]]
    setting = ", ".join(f"{key} {value}" for key, value in found["setting"].items() if value is not None)
    picture = path.with_name("bench.png")
    title = "seconds per frame against PSNR"
    figure = page.stored_figure(opening.content(picture), title) if picture.is_file() else None
    table = page.table(page.Table(setting, [_heading(key) for key in keys], rows))
    return page.section(f"Cost of a frame: {path.parent.name}", figure, table)


def validation_section(path: Path) -> page.Section:
    """Return speed against error of sensor models or of rendering, from the JSON of `qsim validate`."""
    return _of_rendering(path) if "median_ratio" in files.read_json(path) else _of_sensors(path)


def _of_rendering(path: Path) -> page.Section:
    found = stored_results.read(path, stored_results.RenderingValidation)
    rows = found["rows"]
    axes, save = page.axes("seconds per frame", "PSNR against the reference [dB]")
    axes.plot([row["seconds"] for row in rows], [row["psnr"] for row in rows], "o", label="ours")
    naive = [(row["obvious_seconds"], row["obvious_psnr"]) for row in rows]
    axes.plot([x for x, _ in naive], [y for _, y in naive], "o", label="the naive loop")
    axes.set_xscale("log")
    axes.legend()
    keys = ["scene", "level", "psnr", "stated_psnr", "samples", "bounces", "seconds", "obvious_seconds", "ratio"]
    what = f"rendering, frames of {found['height']} × {found['width']}, {found['engine']}"
    table = _validated(what, found["ok"], keys, [dict(row) for row in rows])
    return page.section("Validation", save("speed against error"), table)


def _of_sensors(path: Path) -> page.Section:
    found = stored_results.read(path, stored_results.SensorValidation)
    axes, save = page.axes("million pixels per second", "error of the cdf")
    measured = [row for row in found["rows"] if row["cdf_error"]]
    for engine in dict.fromkeys(row["engine"] for row in measured):
        own = [row for row in measured if row["engine"] == engine]
        axes.plot([row["megapixels_per_second"] for row in own], [row["cdf_error"] for row in own], "o", label=engine)
    axes.set_yscale("log")
    axes.set_xscale("log")
    axes.legend()
    keys = ["model", "engine", "megapixels_per_second", "times_numpy", "cdf_error"]
    keys += ["p_value", "z_mean", "z_variance", "mismatches_per_million"]
    what = f"sensors, {found['pixels']} pixels a draw"
    table = _validated(what, found["ok"], keys, [dict(row) for row in found["rows"]])
    cases = [[case["name"], case["found"], "right" if case["ok"] else "wrong"] for case in found.get("cases", [])]
    hard = page.table(page.Table("hard cases", ["case", "found", ""], cases)) if cases else None
    return page.section("Validation", save("speed against error"), table, hard)


def _validated(what: str, ok: bool, keys: Sequence[str], rows: Sequence[Mapping[str, object]]) -> Markup:
    """Return the table of a validation, with its verdict."""
    verdict = "everything is within its bounds" if ok else "something is OUTSIDE its bounds"
    cells = [[row[key] for key in keys] for row in rows]
    return page.table(page.Table(f"{what}: {verdict}", [_heading(key) for key in keys], cells))


def reading_section(path: Path) -> page.Section:
    """Return the windows read per second from a clip and from video, from the JSON of `qsim validate reading`."""
    found = stored_results.read(path, stored_results.Reading)
    window = " × ".join(map(str, found["window_shape"]))
    clip = " × ".join(map(str, found["clip_shape"]))
    verdict = "as fast as wanted" if found["ok"] else "NOT as fast as wanted"
    what = (
        f"windows of {window} in a clip of {clip}: {verdict} ({found['wanted']:g}/s, {found['wanted_ratio']:g} times)"
    )
    rows = [
        ["clip folder", found["clip"], found["clip_processor"]],
        ["mp4", found["mp4"], found["mp4_processor"]],
    ]
    table = page.table(page.Table(what, ["from", "windows per second", "per second of processor time"], rows))
    return page.section("Reading", table)


def _heading(key: str) -> str:
    """Return a key of a file as a heading with its unit; in files, keys of the naive loop begin with NAIVE."""
    if key in _HEADINGS:
        return _HEADINGS[key]
    for suffix, unit in _SUFFIXES:
        if key.endswith(suffix):
            return key.removesuffix(suffix).replace("_", " ") + unit
    return key.replace(NAIVE, "naive_").replace("_", " ")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float)
