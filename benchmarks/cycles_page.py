"""Writes the page of the rows of cycles_rows.py: what a frame of equal error costs here and in Blender's Cycles."""

from __future__ import annotations

from typing import Any

import numpy as np
import result_page
from reuse_rows import MARK, how

from qsim.tables import markdown_table

TARGET = 5.0  # times faster than the cheapest setting of Cycles that reaches the error
HEAD = (
    "\n".join(
        result_page.head(
            "Beside Blender's Cycles", "cycles_rows.py", ", which makes missing rows, and marked ones again"
        )
    )
    + """
<!-- not run: needs Blender's bpy in a separate environment, and an hour or two -->
```sh
python3.11 -m venv out/bpy
out/bpy/bin/pip install bpy==5.0.0 numpy
python benchmarks/cycles_rows.py --cycles out/bpy/bin/python
```

Both programs render the same clip of {frames} frames, of seed 4, with two threads. `benchmarks/cycles_scene.py` writes
it as a neutral file. `benchmarks/cycles_render.py` imports nothing of ours and renders that file with Blender 5.0.
Lacquered bodies are made diffuse, because the programs have different models of lacquer; metals stay metals.
Cycles gets our pixel area, our number of bounces, no clamp and no adaptive samples. It also gets what makes it
cheaper here: a scene that stays loaded between frames, no light tree, blue noise, and denoisers faster than its
default. It renders three equal colours.

Each program is judged by its own converged pictures. **reached** is in dB below white, picture and truth clamped there,
over several frames. Ours takes a budget that asks for 40 dB. Ours and one setting of Cycles are rendered in turn. **s**
is the median over all frames but the first, in which both programs load, in {clock}.
"""
)
CONVERGED = """## Do both programs compute the same light?

Converged pictures of both, compared before any time is measured. **at least** is the agreement without the noise of
either picture, less three standard errors; **as seen** is with that noise. **light** is the mean light of Cycles over
ours, less one. The pictures agree to {least:.1f} dB or better.
"""


def cheapest(settings: list[dict[str, Any]], level: float, clock: str) -> dict[str, Any] | None:
    """Return the setting that reaches `level` [dB] in the fewest seconds of a clock; None if none does."""
    able = [each for each in settings if each["reached"] >= level]
    return min(able, key=lambda each: each[clock], default=None)


def clock_of(rows: dict[str, dict[str, Any]]) -> str:
    """Return the key of the seconds that decide: wall seconds, or processor seconds if a row is marked."""
    return "wall_seconds" if all(row["quiet"] for row in rows.values()) else "processor_seconds"


def ratios(row: dict[str, Any], clock: str) -> list[float | None]:
    """Return how many times faster ours is than the cheapest setting of Cycles, at the asked and at our error."""
    ours = fastest(row, clock)
    best = [cheapest(row["cycles"], level, clock) for level in (row["plan"]["level"], ours["reached"])]
    return [None if each is None else each[clock] / ours[clock] for each in best]


def fastest(row: dict[str, Any], clock: str) -> dict[str, Any]:
    """Return the faster of our ways to render the clip."""
    return min(row["ours"], key=lambda each: each[clock])


def page(rows: dict[str, dict[str, Any]]) -> str:
    """Return the page of the rows, by name."""
    clock = clock_of(rows)
    frames = " or ".join(map(str, sorted({row["plan"]["frames"] for row in rows.values()})))
    text = [HEAD.format(clock=clock.replace("_seconds", " seconds"), frames=frames)]
    text += [
        *markdown_table([summary(name, row, clock) for name, row in rows.items()], SUMMARY),
        "",
        verdict(rows, clock),
    ]
    least = min(row["agreement"]["difference"] for row in rows.values())
    text += [
        "",
        *[CONVERGED.format(least=least), *markdown_table([agreement(*each) for each in rows.items()], AGREEMENT)],
    ]
    for name, row in rows.items():
        seconds = ", ".join(f"{each['choosing_seconds']:.1f}" for each in row["ours"])
        text += ["", f"## {name}", "", *markdown_table(settings(row), SETTINGS), ""]
        text += [f"Choosing our budget takes {seconds} processor seconds for each clip."]
    machines = sorted({f"{row['processor']}, {row['plan']['threads']} threads" for row in rows.values()})
    text += ["", f"Machine: {'; '.join(machines)}."]
    if not all(row["quiet"] for row in rows.values()):
        text += [
            "",
            f"{MARK.strip()} made beside other programs, without wall seconds; to be made again on quiet cores.",
        ]
    return "\n".join(text) + "\n"


SUMMARY = ("scene", "ours", "s", "Cycles: cheapest as asked", "s", "times", "cheapest as ours", "s", "times")


def summary(name: str, row: dict[str, Any], clock: str) -> tuple[str, ...]:
    """Return the cells of a scene: ours, and the cheapest setting of Cycles at the asked and at our error."""
    ours = fastest(row, clock)
    cells = [name if row["quiet"] else name + MARK, f"{how(ours)}: {ours['reached']:.1f} dB", f"{ours[clock]:.3f}"]
    levels = (row["plan"]["level"], ours["reached"])
    for level, ratio in zip(levels, ratios(row, clock), strict=True):
        best = cheapest(row["cycles"], level, clock)
        if best is None:
            cells += ["none of those tried", "–", "–"]
        else:
            chosen = f"{best['samples']}, {best['denoiser']}: {best['reached']:.1f} dB"
            cells += [chosen, f"{best[clock]:.3f}", f"{ratio:.1f}"]
    return tuple(cells)


def verdict(rows: dict[str, dict[str, Any]], clock: str) -> str:
    """Return whether the target is reached, as a line."""
    found = [ratios(row, clock)[0] for row in rows.values()]
    least = min((each for each in found if each is not None), default=np.inf)
    wanted = "reached" if least >= TARGET else "**not reached**"
    return f"The target, {TARGET:g} times faster than the cheapest setting that reaches what was asked, is {wanted}."


AGREEMENT = ("scene", "at least [dB]", "as seen [dB]", "light [%]", "± [%]")


def agreement(name: str, row: dict[str, Any]) -> tuple[str, ...]:
    """Return the cells of a scene's converged pictures."""
    found = row["agreement"]
    light = (f"{100 * found['mean']:+.3f}", f"{100 * found['mean_error']:.3f}")
    return (name, f"{found['difference']:.1f}", f"{found['as_seen']:.1f}", *light)


SETTINGS = ("program", "samples", "reached [dB]", "wall s", "processor s")


def settings(row: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return a line of cells for each clip of a scene."""

    def line(program: str, samples: str, each: dict[str, Any]) -> tuple[str, ...]:
        wall = f"{each['wall_seconds']:.3f}" if row["quiet"] else "–"
        return (program, samples, f"{each['reached']:.1f}", wall, f"{each['processor_seconds']:.3f}")

    lines = [line("ours", how(each), each) for each in row["ours"]]
    return lines + [line(f"Cycles, {each['denoiser']}", str(each["samples"]), each) for each in row["cycles"]]
