"""Draws bit-depth studies as PNG: PSNR over bit depth, and the best depth over speed and light."""

from __future__ import annotations

import numpy as np

from qsim.clip.motion_statistics import CODE_BITS
from qsim.figures import figure_png, new_figure
from qsim.studies.bit_depth.answer import code_motion, marked
from qsim.studies.bit_depth.clip_study import Study
from qsim.studies.bit_depth.readout import MODELS
from qsim.studies.bit_depth.speed_sweep import Sweep

COLOURS = {"planes": "tab:orange", "multibit": "tab:blue"}


def study_figure(found: Study) -> bytes:
    """Return PSNR and the parts of the error over bit depth as PNG; points are simulated, lines expected."""
    drawing = new_figure(10, 3.8)
    left, right = drawing.subplots(1, 2)
    for model in MODELS:
        rows = [row for row in found.rows if row.model == model]
        bits = [row.bits for row in rows]
        colour = COLOURS[model]
        left.plot(bits, [row.psnr_predicted_db for row in rows], color=colour, label=f"{model}, expected")
        errors = [2 * row.psnr_error_db for row in rows]
        left.errorbar(bits, [row.psnr_db for row in rows], errors, fmt="o", color=colour, label=f"{model}, simulated")
    rows = [row for row in found.rows if row.model == "multibit"]
    bits = [row.bits for row in rows]
    for field, style in (("blur_error", "o"), ("shot_error", "s"), ("quantisation_error", "^"), ("read_error", "v")):
        values = np.abs([getattr(row, field) for row in rows]) / found.peak
        right.plot(
            bits, np.where(values > 0, values, np.nan), style, label=f"|{field.replace('_', ' ')}|", linestyle="-"
        )
    right.plot(bits, [row.blur_predicted / found.peak for row in rows], "k:", label="blur by the structure function")
    pixels = ", moving pixels" if found.moving else ""
    left.set_ylabel(f"PSNR of the maximum-likelihood frame{pixels} [dB]")
    right.set_ylabel("rms error / peak (multibit)")
    right.set_yscale("log")
    for axes in (left, right):
        axes.set_xlabel("bits per frame of 2^b - 1 planes")
        axes.set_xticks(bits)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7)
    lux = "" if found.lux is None else f" ({found.lux:.3g} lx at 555 nm)"
    drawing.suptitle(f"{found.clip}: {found.ppp:.3g} photons per pixel and plane{lux}, {found.frame_rate:g} planes/s")
    return figure_png(drawing)


def sweep_figure(found: Sweep) -> bytes:
    """Return the best bit depth over speed and light as PNG: simulated, and the law's where that is another one.

    A hatched cell is an edge: the best depth is the deepest or the least deep that was tried.
    """
    from matplotlib.patches import Rectangle

    drawing = new_figure(11, 4.2)
    bits = sorted({row.bits for line in found.studies for one in line for row in one.rows})
    pixels = ", moving pixels" if found.studies[0][0].moving else ""
    panels = list(drawing.subplots(1, 2))
    colours = {"cmap": "viridis", "vmin": bits[0] - 0.5, "vmax": bits[-1] + 0.5}
    for axes, model in zip(panels, MODELS, strict=True):
        table = np.array([[s.best(model).bits for s in row] for row in found.studies])
        drawn = axes.imshow(table, origin="lower", aspect="auto", **colours)
        for (i, j), best in np.ndenumerate(table):
            shown = marked(found.studies[i][j], model)
            near = "white" if best <= np.mean(bits) else "black"
            if shown != str(best):
                axes.add_patch(
                    Rectangle((j - 0.5, i - 0.5), 1, 1, fill=False, hatch="///", edgecolor="0.5", linewidth=0)
                )
            words = shown.replace(">= ", "≥ ").replace("<= ", "≤ ")
            axes.text(j, i, words, ha="center", va="center", color=near, fontsize=12)
            if (law := int(found.predicted[model][i, j])) != best:
                axes.text(j, i - 0.3, f"law: {law}", ha="center", va="center", color=near, fontsize=7)
        axes.set_xticks(range(len(found.ppps)), [f"{p:.2g}" for p in found.ppps])
        axes.set_yticks(range(len(found.speeds)), [_speed_label(found, i) for i in range(len(found.speeds))])
        axes.set_xlabel("photons per pixel and plane")
        axes.set_ylabel(f"speed (px per {CODE_BITS}-bit frame)")
        axes.set_title(f"best bits, {model}{pixels}")
    drawing.colorbar(drawn, ax=panels, ticks=bits, label="bits; hatched: at the edge of what was tried")
    return figure_png(drawing)


def _speed_label(found: Sweep, i: int) -> str:
    row = found.studies[i][0].rows[0]
    motion = code_motion(row)
    return f"{found.speeds[i]:g}" + ("" if motion is None else f" ({motion:.2g})")
