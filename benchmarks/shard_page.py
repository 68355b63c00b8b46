"""Writes the page of what `shard_cost.py` found: targets, planned and used cost, motion and light of a shard."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import result_page
from shard_contents import EDGES, FITTED, LOOKED_AT, MOTION, RINGS

from qsim.clip.motion_statistics import MOVING
from qsim.figures import new_figure, write_figure
from qsim.tables import markdown_table

WAYS = {"alone": "each frame alone", "reuse": "frames that share samples"}
SHARE = 1 / 3  # wanted processor hours with reuse, of those without
WITHIN = (0.7, 1.3)  # wanted processor hours used, of those planned
MOST_MEMORY = 2.5  # GB of a worker

HEAD = (
    "\n".join(
        result_page.head(
            "A shard of {recipe}: planned, made and measured",
            "shard_cost.py",
            ", which keeps all numbers in the json file beside this page",
        )
    )
    + """
`scenes/{recipe}.toml` has {clips} clips. The other recipe below differs from it in one line, `reuse = false`. Shard
{part} has the clips {names}.

<!-- not run: plans of an hour or two, and a shard of up to an hour, on two cores -->
```sh
mkdir -p out
awk '{{print}} /^psnr = /{{print "reuse = false"}}' scenes/{recipe}.toml > out/alone.toml
qsim plan out/alone.toml --json > out/plan_alone.json                           # 30 to 60 minutes on two cores
qsim plan scenes/{recipe}.toml --json > out/plan.json                       # 20 to 60 minutes
qsim plan scenes/{recipe}.toml --shard {part} --json > out/plan_shard.json  # 5 to 15 minutes
qsim generate scenes/{recipe}.toml -o out/i2 --shard {part}                 # 20 to 60 minutes
python benchmarks/shard_cost.py --shard {part} --alone out/plan_alone.json --reuse out/plan.json \\
    --shard-plan out/plan_shard.json --data out/i2  # a minute
```

The times are estimates. Hours are of processor time, of all threads, unless they are called wall hours. 1 GB is 10⁹
bytes. A clip that is made on the machine of its plan finds the kernels that the plan compiled.
"""
)
MISSING = "not measured yet"


def page(found: dict[str, Any], figure: str) -> str:
    """Return the page of what was found; `figure` is the name of its figure."""
    names = ", ".join(f"`{name}`" for name in found["shard"])
    text = [HEAD.format(recipe=found["recipe"], clips=found["clips"], part=found["part"], names=names)]
    text += ["## Targets", "", *markdown_table(targets(found), ("what", "wanted", "found", "target")), ""]
    text += ["## The whole recipe", "", *whole(found["plans"]), "## The shard", "", *costs(found)]
    shown = light(found["made"]["clips"], figure) if "made" in found else [f"{MISSING.capitalize()}.", ""]
    text += ["## Motion and light of the shard", "", *shown]
    return "\n".join([*text, *machines(found)])


def targets(found: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return the cells of each target."""
    plans = found["plans"]
    made = found.get("made")
    share = memory = used = None
    if {"alone", "reuse"} <= plans.keys():
        share = plans["reuse"]["processor_hours"] / plans["alone"]["processor_hours"]
    if made is not None:
        memory = max(clip["memory"] for clip in made["clips"].values())
    if made is not None and "shard" in plans:
        used = total(made["clips"].values(), "processor_hours") / total(planned(found, "shard"), "processor_hours")

    def line(what: str, wanted: str, value: float | None, reached: bool, unit: str = "") -> tuple[str, ...]:
        if value is None:
            return (what, wanted, MISSING, "–")
        return (what, wanted, f"{value:.2f}{unit}", "reached" if reached else "**not reached**")

    low, high = WITHIN
    return [
        line("hours of the recipe: with reuse over without", f"at most {SHARE:.2f}", share, (share or 0) <= SHARE),
        line("hours of the shard: used over planned", f"{low:g} to {high:g}", used, low <= (used or 0) <= high),
        line("most memory of a worker", f"at most {MOST_MEMORY:g} GB", memory, (memory or 0) <= MOST_MEMORY, " GB"),
    ]


def planned(found: dict[str, Any], plan: str) -> list[dict[str, Any]]:
    """Return the planned cost of each clip of the shard, by the plan of the shard or of a whole recipe."""
    kinds = found["plans"][plan]["kinds"]
    return [kinds[number["shard" if plan == "shard" else "whole"]] for number in found["shard"].values()]


def total(costs: Iterable[dict[str, Any]], key: str) -> float:
    return float(sum(each[key] for each in costs))


def whole(plans: dict[str, Any]) -> list[str]:
    """Return the tables of the plans of the whole recipe."""
    given = {way: plans[way] for way in WAYS if way in plans}
    if not given:
        return [f"{MISSING.capitalize()}.", ""]
    keys = {"hours": "processor_hours", "wall hours, one worker": "wall_hours", "GB": "gigabytes"}
    keys["memory of the planning process [GB]"] = "memory"
    columns = {WAYS[way]: plan for way, plan in given.items()}
    lines = [(name, *(f"{plan[key]:.3g}" for plan in columns.values())) for name, key in keys.items()]
    text = [*markdown_table(lines, ("", *columns)), ""]
    text += ["Samples per pixel, and neighbours on each side, are the fewest and the most of up to five clips:", ""]
    header: list[str] = ["family", "clips"]
    for way in given:
        header += [f"hours, {WAYS[way]}", "samples", "neighbours"]
    rows = []
    for kinds in zip(*(plan["kinds"] for plan in given.values()), strict=True):
        cells = [kinds[0]["family"], f"{kinds[0]['clips']}"]
        for kind in kinds:
            cells += [f"{kind['clips'] * kind['processor_hours']:.2f}", span(kind["samples"]), span(kind["neighbours"])]
        rows.append(cells)
    missing = [f"with {WAYS[way]}" for way in WAYS if way not in plans]
    return [*text, *markdown_table(rows, header), "", *(f"The plan {name} is {MISSING}.\n" for name in missing)]


def span(values: Sequence[int]) -> str:
    return "–".join(map(str, sorted(set(values))))


def costs(found: dict[str, Any]) -> list[str]:
    """Return the table of planned and used cost of the shard's clips, with what is known of it."""
    plans = found["plans"]
    made = found.get("made")
    way = made["way"] if made is not None else plans.get("shard", {}).get("way", "reuse")
    columns: dict[str, list[dict[str, Any]]] = {}
    if way in plans:
        columns["planned, mean of the family"] = planned(found, way)
    if "shard" in plans:
        columns["planned for the clip"] = planned(found, "shard")
    if made is not None:
        columns["used"] = [made["clips"][name] for name in found["shard"]]
    rows = []
    names = [*found["shard"], "together"]
    for key, unit in (("processor_hours", "hours"), ("wall_hours", "wall hours"), ("gigabytes", "GB")):
        for i, name in enumerate(names):
            values = [total(column, key) if name == "together" else column[i][key] for column in columns.values()]
            known = made is not None and len(values) > 1 and values[-2] > 0
            ratio = f"{values[-1] / values[-2]:.2f}" if known else "–"
            rows.append((name, unit, *(f"{value:.3f}" for value in values), ratio))
    text = [f"With {WAYS[way]}. Wall hours are those of one worker beside whatever else ran, planned ones too.", ""]
    text += [*markdown_table(rows, ("clip", "unit", *columns, "used over planned")), ""] if columns else []
    if "shard" not in plans:
        text += [f"The plan of the shard is {MISSING}.", ""]
    if made is None:
        return [*text, f"The shard itself is {MISSING}.", ""]
    header = ("clip", "frames", "samples", "neighbours", "stated [dB]", "memory of its worker [GB]")
    facts = [
        (
            name,
            f"{clip['shape'][0]}",
            *("–" if clip[key] is None else f"{clip[key]}" for key in ("samples", "neighbours")),
            "–" if clip["psnr"] is None else f"{clip['psnr']:.1f}",
            f"{clip['memory']:.2f}",
        )
        for name, clip in made["clips"].items()
    ]
    text += [*markdown_table(facts, header), ""]
    text += ["Memory is the most that a worker held until the clip was finished, its clips before included."]
    if "shard" in plans:
        held = plans["shard"]["memory"]
        text += [f"The process that planned the shard held {held:.2f} GB; it renders a few frames of a clip, not all."]
    return [*text, ""]


def light(clips: dict[str, Any], figure: str) -> list[str]:
    """Return the tables of motion, contrast and spectrum."""
    together = {"known": sum(clip["motion"]["known"] for clip in clips.values())}
    together["counts"] = np.sum([clip["motion"]["counts"] for clip in clips.values()], axis=0)
    together["summed"] = sum(clip["motion"]["summed"] for clip in clips.values())
    motions = {name: clip["motion"] for name, clip in clips.items()} | {"together": together}
    low, high = MOTION
    spans = (f"{MOVING:g} to {low:g}", f"{low:g} to {high:g}", f"over {high:g}")
    lines = []
    for name, each in motions.items():
        moving = sum(each["counts"])
        shares = [f"{100 * share:.1f} %" for share in below_within_above(each["counts"])]
        mean = f"{each['summed'] / moving:.2f}" if moving else "–"
        lines.append((name, f"{100 * moving / max(each['known'], 1):.1f} %", mean, *shares))
    slower, within, faster = (100 * share for share in below_within_above(together["counts"]))
    text = [f"A pixel moves if its flow to the next frame is at least {MOVING:g} px. The last columns are shares of"]
    text += ["the moving pixels, by px/frame.", ""]
    text += [*markdown_table(lines, ("clip", "moving pixels", "mean [px/frame]", *spans)), ""]
    text += [f"The paper states {low:g} to {high:g} px/frame. Here {within:.0f} % of the moving pixels are within,"]
    text += [f"{slower:.0f} % are slower and {faster:.0f} % faster.", "", f"![Motion and spectrum]({figure})", ""]
    header = ("clip", "rms contrast", "1st percentile", "99th percentile", "exponent of the spectrum")
    rows = []
    for name, clip in clips.items():
        values = (clip["contrast"]["rms"], clip["contrast"]["low"], clip["contrast"]["high"], clip["slope"])
        rows.append((name, *("–" if value is None else f"{value:.2f}" for value in values)))
    first, last = (f"1/{1 / frequency:g}" for frequency in FITTED)
    text += [f"Radiance over its mean, in at most {LOOKED_AT} frames of each clip. The exponent is that of a power law"]
    text += [f"fitted to the power, averaged over rings, between {first} and {last} cycles/px. For photographs of"]
    text += ["nature it is about -2 (D. J. Field, J. Opt. Soc. Am. A 4, 2379, 1987). Contrast and spectrum have no"]
    text += ["target.", ""]
    return [*text, *markdown_table(rows, header), ""]


def below_within_above(counts: Sequence[int]) -> tuple[float, float, float]:
    """Return the shares of moving pixels below, within and above MOTION; zeros without any."""
    low, high = (EDGES.index(edge) for edge in MOTION)
    parts = [sum(counts[:low]), sum(counts[low:high]), sum(counts[high:])]
    below, within, above = (float(each) / max(sum(parts), 1) for each in parts)
    return below, within, above


def machines(found: dict[str, Any]) -> list[str]:
    """Return the lines on machines and versions."""
    given = [*found["plans"].values(), *([found["made"]] if "made" in found else [])]
    engines = sorted({plan["engine"] for plan in found["plans"].values()})
    if not given:
        return []
    names = sorted({each["processor"] for each in given})
    return [f"Machine: {'; '.join(names)}{'; ' if engines else ''}{'; '.join(engines)}. Version {found['qsim']}.", ""]


def draw(clips: dict[str, Any], path: Path) -> None:
    """Draw the histograms of motion and the spectra of the clips."""
    figure = new_figure(9.0, 3.6)
    left, right = figure.subplots(1, 2)
    edges = np.array(EDGES[:-1])
    middle = np.sqrt(RINGS[1:] * RINGS[:-1])
    fastest = MOTION[1]
    for name, clip in clips.items():
        counts = np.array(clip["motion"]["counts"][:-1], float)
        fastest = max([fastest, *edges[1:][counts > 0]])
        left.stairs(100 * counts / np.diff(edges) / max(sum(clip["motion"]["counts"]), 1), edges, label=name)
        power = np.array([np.nan if value is None else value for value in clip["spectrum"]], float)
        exponent = "" if clip["slope"] is None else f", f^{clip['slope']:.2f}"
        right.loglog(middle, power, marker=".", label=f"{name}{exponent}")
    left.axvspan(*MOTION, color="0.9", zorder=0, label="the paper")
    left.set_xlim(0, fastest + 0.5)
    left.set_xlabel("motion [px/frame]")
    left.set_ylabel("moving pixels [% per px/frame]")
    left.legend(fontsize="small")
    for frequency in FITTED:
        right.axvline(frequency, color="0.7", linewidth=0.8)
    right.set_xlabel("spatial frequency [cycles/px]")
    right.set_ylabel("power of radiance over mean [px²]")
    right.legend(fontsize="small")
    write_figure(figure, path)
