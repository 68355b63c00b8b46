"""Runs the validations on this machine and writes their numbers to the page "How do we know it is right?".

    python benchmarks/evidence.py          # qsim validate sensor, render, light, engines, reading -> evidence.json, .md
    python benchmarks/evidence.py render   # run one again, keep the others of evidence.json
    python benchmarks/evidence.py --page-only  # write evidence.md from evidence.json

All numbers in the tables come from evidence.json.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import textwrap
from pathlib import Path
from statistics import median
from typing import Any

from qsim import scenes
from qsim.studies.validation import rendering as validate_render
from qsim.tables import markdown_table

HERE = Path(__file__).parents[1] / "docs"
NUMBERS = HERE / "evidence.json"
FIGURE = HERE / "pictures" / "rendering.png"
UNTUNED = [name for name in scenes.FAMILIES if name not in (*validate_render.TUNED, "macro")]  # it distorts
VALIDATIONS = {
    "sensor": [],
    "render": ["--scenes", *UNTUNED, "--seed", "1", "-o", str(FIGURE), "--force"],
    "light": ["--scenes", *UNTUNED, "--seed", "1", "--height", "64", "--width", "96"],
    "engines": ["--scenes", "fan", "flag", "--height", "512", "--width", "1024"],
    "reading": [],
}

HEAD = """# How do we know it is right?

Every approximate number is compared with an exact one, and every speed is shown with its error. A correct
program meets all bounds: exact forms to rounding, statistics with one false alarm
in a million reports ([terms](glossary.md)).
"""

MAKING = """*Made by `python benchmarks/evidence.py` from `qsim validate`; run that for the numbers of your machine.
Other programs on a machine change speeds, not errors.*

<!-- not run: an hour; tests/system/test_docs.py compares the page with its numbers -->
```sh
python benchmarks/evidence.py
```
"""

SENSOR = """## Sensors

| column | meaning |
|---|---|
| cdf error | largest difference of P(code ≤ k) from independent sums and integrals |
| p; z | chi-square of drawn codes against the closed form; mean and variance in standard errors |
| differ | pixels in a million at which compiled and reference engine differ for the same key |
| × NumPy | speed relative to the usual lines of NumPy (Poisson, normal, round, clip) in the same process |
"""

RENDERING = """## Rendering

Radiance is compared with a converged reference of the same scene. All are in dB below [white](fidelity.md),
clamped there.

| column | meaning |
|---|---|
| asked, reached | the requested PSNR, and that of a frame against the reference |
| stated | PSNR by the frame's measured noise and the bounces that the pilot omits |
| samples | of the chosen budget, raised where the frame missed the request; neighbours share samples |
| naive | a loop of one `mi.render` per frame, with the power of two of samples that reaches the same PSNR |

The scenes that tuned the choice of budgets (fan, tumble, gears, flag, crowd, drums, text) are not shown, nor
is macro, whose lens distorts. One constant was chosen on these: the deepest bounce, which glass needs. Glossy
at 30 dB states more than was reached, because eight samples miss rare bright paths. [More at 40
dB](results/clips.md).
"""

STORED_BEFORE = (
    "These rows were stored before the chosen numbers of samples were: which of them were raised is not known, and "
    "**stated** is of another frame than **reached**."
)

LIGHT = """### Error and light

| column | meaning |
|---|---|
| reached, stated | dB below white, with picture and truth clamped there; without clamp: the same white |
| light | mean light of three frames less that of converged ones |
| announced, ± | loss by the omitted bounces, as `--explain` states it; standard error of the difference |
"""

ENGINES = """## Engines

The same frames, radiance and ground truth, by each engine that works on the machine. **outside kernels** is
the fraction of the time without a compiled kernel: moving the scene, ground truth, measuring the error.
"""

READING = """## Reading

Windows for training at random places of one clip; both readers reopen their files for every window. One
thread reads the clip folder, FFmpeg decodes the mp4 on all cores.
"""

OTHER = """## Another renderer

Blender's Cycles is a path tracer by other people. Converged pictures of both are compared, and frames of
equal error are timed: [beside Cycles](results/cycles.md). glTF from Blender is compared [beside
Blender](results/blender.md).
"""

TESTS = """## Which test checks which claim

| claim | test |
|---|---|
| photons: worked numbers, EMVA formula, laws | `tests/qsim/optics/test_radiometry.py` |
| radiance of a closed box and of a Lambertian plane | `test_renderer.py`, `test_mitsuba_scene.py` |
| stated error of a frame agrees with the true one | `test_renderer.py`, `test_fidelity.py`, `test_fidelity_white.py` |
| mean light within the announced error | `test_light.py`, `test_denoiser.py` |
| compiled and reference engine agree over 10 000 random sensors | `tests/qsim/sensor/compiled/test_codes_search.py` |
| codes have the exact distribution: tails, ties, dead times | `tests/qsim/sensor/test_qis.py`, `test_counting.py` |
| closed forms agree with the simulation of every photon | `tests/qsim/sensor/defects/test_event_simulation.py` |
| no two frames are equal; any order, any workers, same bytes | `tests/qsim/dataset/test_dataset.py`, `test_keys.py` |
| killed runs, full disks, damaged files | `tests/qsim/dataset/test_dataset.py`, `tests/system/test_mistakes.py` |
| statistical helpers have their stated false alarms and power | `tests/support/test_stats.py` |
| measured photons agree with the models | `tests/system/test_real_photons.py` |
| the network is the published one | `tests/quiver/model/test_golden.py` |
"""


def measure(what: str) -> dict[str, Any]:
    """Run one validation in a separate process; return its report and the machine."""
    machine = {"python": platform.python_version(), "processor": f"{platform.machine()}, {os.cpu_count()} cores"}
    command = [sys.executable, "-m", "qsim", "validate", what, "--json", *VALIDATIONS[what]]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode not in (0, 1):
        raise SystemExit(done.returncode)
    return {"machine": machine, "report": json.loads(done.stdout)}


def page(found: dict[str, Any]) -> str:
    """Return the page as Markdown."""
    shown = []
    sections = {"sensor": sensor, "render": rendering, "light": light, "engines": engines, "reading": reading}
    places = {
        what: f"Python {found[what]['machine']['python']} on {found[what]['machine']['processor']}" for what in sections
    }
    for what, section in sections.items():
        shown.append(section(found[what]["report"]))
        if len(set(places.values())) > 1:
            shown.append(f"*{places[what]}.*\n")
    where = f"*{places['sensor']}.*\n" if len(set(places.values())) == 1 else ""
    return "\n".join([HEAD, summary(found), where, *shown, OTHER, TESTS, MAKING]).rstrip() + "\n"


def summary(found: dict[str, Any]) -> str:
    """Return a table of one line for each part."""
    reports = {what: found[what]["report"] for what in found}
    fast = [row for row in reports["sensor"]["rows"] if row["engine"] == "fast"]
    errors = [row["cdf_error"] for row in fast if row["cdf_error"] is not None]
    differ = [row["mismatches_per_million"] for row in fast if row["mismatches_per_million"] is not None]
    speeds = [row["times_numpy"] for row in fast if row["times_numpy"] is not None]
    missed = [abs(row["reached"] - row["stated"]) for row in reports["light"]["rows"]]
    answers = [
        (
            "sensor",
            f"P(code ≤ k) within {max(errors):.0e}; {max(differ):.1f} codes in a million differ from the exact engine",
        ),
        ("sensor speed", f"{min(speeds):.1f} to {max(speeds):.1f} times the usual lines of NumPy"),
        (
            "render",
            f"at 40 dB the median scene takes 1/{reports['render']['median_ratio']:.1f} of the naive loop's time",
        ),
        ("light", f"stated and reached error differ by up to {max(missed):.1f} dB; mean light as announced"),
        (
            "engines",
            "means of the engines agree" if reports["engines"]["ok"] else "means of the engines **do not agree**",
        ),
        ("reading", f"{reports['reading']['ratio']:.1f} times as many windows as from an mp4"),
    ]
    rows = []
    for part, answer in answers:
        ok = reports[part.split()[0]]["ok"]
        rows.append([part, answer, "yes" if ok else "**no**"])
    return _table(["part", "measured", "within its bounds"], rows) + "\n"


def sensor(report: dict[str, Any]) -> str:
    header = ["model", "engine", "cdf error", "p", "z mean", "z variance", "differ [10⁻⁶]", "10⁶ pixels/s", "× NumPy"]
    styles = {
        "cdf_error": ".1e",
        "p_value": ".3f",
        "z_mean": "+.1f",
        "z_variance": "+.1f",
        "mismatches_per_million": ".1f",
        "megapixels_per_second": ".1f",
        "times_numpy": ".1f",
    }
    rows = [
        [row["model"], row["engine"], *(_number(row[key], style) for key, style in styles.items())]
        for row in report["rows"]
        if row["engine"] != "numpy"  # its speed is that of the last column
    ]
    verdict = "Everything is within its bounds." if report["ok"] else "**Something is outside its bounds**: see below."
    outside = [
        f"- {row['model']}, {row['engine']}: {', '.join(row['wrong'])}" for row in report["rows"] if row["wrong"]
    ]
    cases = _cases(report["cases"])
    count = f"{report['pixels']} pixels a draw. {verdict}"
    return "\n".join(
        [
            SENSOR,
            _table(header, rows),
            "",
            count,
            *outside,
            "",
            "### Hard cases",
            "",
            _table(["case", "found", ""], cases),
            "",
        ]
    )


def _cases(cases: list[dict[str, Any]]) -> list[list[str]]:
    """Return a row for each hard case; those of one kind that are right share the row of the worst."""
    kind = "sum of probabilities 1 +- "
    sums = [case for case in cases if case["ok"] and case["found"].startswith(kind)]
    rows = []
    if sums:
        worst = max(sums, key=lambda case: float(case["found"].removeprefix(kind)))
        _, _, light = worst["name"].rpartition(": ")
        rows.append([f"{len(sums)} models: {light}", f"{worst['found']}, the worst", "right"])
    others = [case for case in cases if case not in sums]
    return rows + [[case["name"], case["found"], "right" if case["ok"] else "**wrong**"] for case in others]


def rendering(report: dict[str, Any]) -> str:
    header = [
        "scene",
        "asked [dB]",
        "reached [dB]",
        "stated [dB]",
        "samples",
        "denoised",
        "bounces",
        "s/frame",
        "naive s/frame",
        "naive [dB]",
        "times faster",
    ]
    rows = [
        [
            row["scene"],
            f"{row['level']:g}",
            f"{row['psnr']:.1f}",
            f"{row['stated_psnr']:.1f}",
            _samples(row),
            "yes" if row["denoised"] else "no",
            str(row["bounces"]),
            f"{row['seconds']:.2f}",
            f"{row['obvious_seconds']:.2f}" + (" (extrapolated)" if row["extrapolated"] else ""),
            f"{row['obvious_psnr']:.1f}",
            f"{row['ratio']:.1f}",
        ]
        for row in report["rows"]
    ]
    at = [row for row in report["rows"] if row["level"] == validate_render.AT_LEVEL and not row.get("neighbours")]
    # The squared error of independent samples is c / n, so that a PSNR x dB lower takes 10^(-x / 10) of the time.
    equal = median(row["ratio"] * 10 ** ((row["psnr"] - row["obvious_psnr"]) / 10) for row in at)
    exact = median(row["ratio"] * 10 ** ((row["level"] - row["obvious_psnr"]) / 10) for row in at)
    wanted = "reached" if report["ok"] else "**not reached**"
    size = (
        f"*Frames of {report['height']} × {report['width']}.* The required speed is {wanted} in this run: 10 times in "
        f"the median at 40 dB, and nowhere slower. The median is {report['median_ratio']:.1f} times. The loop uses "
        f"powers of two of samples and overshoots. If it could stop at our PSNR, the median would be {equal:.1f}. If "
        f"it could stop at exactly 40 dB, it would be {exact:.1f}."
    )
    before = [] if all("chosen_samples" in row for row in report["rows"]) else [_lines(STORED_BEFORE), ""]
    picture = f"![Seconds per frame against PSNR]({FIGURE.relative_to(HERE).as_posix()})"
    return "\n".join([RENDERING, _table(header, rows), "", *before, _lines(size), "", picture, ""])


def _samples(row: dict[str, Any]) -> str:
    """Return the samples of a row, those chosen if they were raised, and the neighbours that share them."""
    chosen = row.get("chosen_samples")
    neighbours = row.get("neighbours")
    raised = f", raised from {chosen}" if chosen and chosen < row["samples"] else ""
    return f"{row['samples']}{raised}" + (f", {neighbours} neighbours" if neighbours else "")


def light(report: dict[str, Any]) -> str:
    header = [
        "scene",
        "asked [dB]",
        "reached [dB]",
        "stated [dB]",
        "reached without clamp [dB]",
        "stated without clamp [dB]",
        "samples",
        "denoised",
        "bounces",
        "light [%]",
        "announced [%]",
        "± [%]",
    ]
    rows = [
        [
            row["scene"],
            f"{row['asked']:g}",
            *(f"{row[key]:.1f}" for key in ("reached", "stated", "reached_unclamped", "stated_unclamped")),
            str(row["samples"]),
            "yes" if row["denoised"] else "no",
            str(row["bounces"]),
            f"{100 * row['light']:+.3f}",
            f"{-100 * row['announced']:+.3f}",
            f"{100 * row['light_error']:.3f}",
        ]
        for row in report["rows"]
    ]
    wrong = [row["scene"] for row in report["rows"] if not row["ok"]]
    verdict = f"**not** in {', '.join(wrong)}" if wrong else "everywhere"
    size = (
        f"Frames of {report['height']} × {report['width']}. The error is within 0.5 dB of the request, and the light "
        f"within 4.5 standard errors of the announced loss, {verdict}."
    )
    return "\n".join([LIGHT, _table(header, rows), "", _lines(size), ""])


def engines(report: dict[str, Any]) -> str:
    header = ["scene", "engine", "s/frame", "times scalar", "outside kernels", "mean radiance", "off by [std. errors]"]
    rows = [
        [
            row["scene"],
            row["engine"],
            f"{row['seconds']:.2f}",
            f"{row['ratio']:.1f}",
            "–" if row["outside"] is None else f"{100 * row['outside']:.1f} %",
            f"{row['mean']:.5g} ± {row['mean_error']:.1g}",
            "–" if row["engine"] == "scalar" else f"{row['deviation']:.1f}",
        ]
        for row in report["rows"]
    ]
    missing = [_lines(f"- {backend}: {why}") for backend, why in report["missing"].items()]
    agree = "agree" if report["ok"] else "**do not agree**"
    size = f"Frames of {report['height']} × {report['width']}, {report['samples']} samples; the means {agree}."
    return "\n".join([ENGINES, _table(header, rows), "", size, "", *missing, ""])


def reading(report: dict[str, Any]) -> str:
    header = ["from", "windows/s", "windows per processor second"]
    rows = [
        [name, f"{report[side]:.1f}", f"{report[f'{side}_processor']:.1f}"]
        for name, side in (("clip folder", "clip"), ("mp4", "mp4"))
    ]
    window, clip = (" × ".join(map(str, report[key])) for key in ("window_shape", "clip_shape"))
    wanted = "reached" if report["ok"] else "**not reached**"
    caption = f"*Windows of {window} (frames, rows, columns) in a clip of {clip}.*"
    text = (
        f"The clip folder gives {report['ratio']:.1f} times as many. The pictures are equal to "
        f"{report['difference']:.3f} of white, the loss of the video."
    )
    speed = (
        f"The required speed ({report['wanted']:g} windows/s, {report['wanted_ratio']:g} times the mp4) is {wanted} in "
        "this run."
    )
    return "\n".join([READING, _table(header, rows), "", caption, "", _lines(text), "", speed, ""])


def _lines(text: str) -> str:
    """Return a paragraph in lines of the pages."""
    return textwrap.fill(text, 110, subsequent_indent="  " * text.startswith("- "), break_on_hyphens=False)


def _number(value: float | None, style: str) -> str:
    return "–" if value is None else format(value, style)


def _table(header: list[str], rows: list[list[str]]) -> str:
    return "\n".join(markdown_table(rows, header))


def main(words: list[str]) -> int:
    found = json.loads(NUMBERS.read_text()) if NUMBERS.is_file() else {}
    if words != ["--page-only"]:
        for what in words or VALIDATIONS:
            found[what] = measure(what)
            NUMBERS.write_text(json.dumps(found, indent=1, sort_keys=True) + "\n")
    (HERE / "evidence.md").write_text(page(found), encoding="utf-8")
    print(f"{HERE / 'evidence.md'}: written")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
