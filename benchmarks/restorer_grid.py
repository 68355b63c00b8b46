"""Scores the restorer that ships and every classical method on test clips: sensor x bits x light, by motion, too.

    qsim generate scenes/restorer_test.toml -o out/restorer_test
    python benchmarks/restorer_grid.py out/restorer_test                             # what is missing: hours
    python benchmarks/restorer_grid.py out/restorer_test --cells qis-3-3.25 --out out/grid --restorer out/mine

A cell is RESULTS/NAME.json: QIS with 1 to 7 bits at six levels of light, and sums of 1, 7 and 31 SPAD planes at three.
It grows by clips and methods; only what is missing is measured, and with other weights only the restorer. Classical
methods run with several windows; the best one counts, chosen by the mean over clips in the cell, or in the bin of
motion. Tables beside RESULTS show the cells that are complete.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import restorer_cells
import result_page
from restorer_cells import Place

from qsim.figures import new_figure, write_figure
from qsim.files import read_json, write_bytes
from qsim.streams.clip import Clip
from qsim.tables import markdown_table
from quiver.data.clips import open_clips, peak_of
from quiver.data.codes import sensed
from quiver.data.illumination import Illumination
from quiver.evaluation import metrics
from quiver.evaluation.breakdown import bin_names, by_motion, pooled, speeds
from quiver.restoration.restorers import restorer

ROOT = Path(__file__).parents[1]
FORMAT = "quiver-restorer-grid-1"
CLASSICAL = (
    *("naive", "moment:3", "moment:7", "moment:11", "transform-denoise:3", "transform-denoise:7", "transform-denoise"),
    *("qbp:5", "qbp", "qbp-bm3d:5", "qbp-bm3d", "path-merge"),
)
BITS = (1, 2, 3, 5, 7)
LIGHTS = (0.5, 1.0, 3.25, 9.75, 26.0, 100.0)  # photons per pixel and code
PLANES = {1: (0.3, 1.0, 3.0), 3: (1.0, 4.9, 15.0), 5: (5.0, 20.0, 60.0)}  # bits of a sum: light of its planes together
FRAMES = 4  # of every clip, evenly spread; the window around each is complete


def places() -> list[Place]:
    """Return all cells."""
    qis = [Place(f"qis-{b}-{ppp:g}", Illumination.of("quiver-physical", ppp, b)) for b in BITS for ppp in LIGHTS]
    spad = [(2**b - 1, Illumination.of("spad-320x240", ppp, b)) for b, levels in PLANES.items() for ppp in levels]
    return qis + [Place(f"spad-{planes}-{light.ppp:g}", light) for planes, light in spad]


def main(words: list[str] | None = None) -> int:
    args = options().parse_args(words)
    every = {place.name: place for place in places()}
    names = list(every) if args.cells is None else args.cells.split(",")
    try:
        for name in names:
            if name not in every:
                raise ValueError(f"no cell is called {name!r}; known are {', '.join(every)}")
        clips = open_clips(args.data, "test")
        if not clips:
            raise ValueError(f"{args.data}: no finished clip in split 'test'; finish `qsim generate`")
        args.out.mkdir(parents=True, exist_ok=True)
        for name in names:
            measure = partial(measured, light=every[name].light, args=args)
            path = args.out / f"{name}.json"
            restorer_cells.grow(path, clips, args.restorer, CLASSICAL, measure, format=FORMAT, frames=args.frames)
        weights = restorer_cells.digest_of(args.restorer)
        known = [name for name in every if measured_with(args.out / f"{name}.json", weights)]
        write_tables(args.out, known, [clip.name for clip in clips])
    except (ValueError, OSError) as error:
        print(f"restorer_grid: {error}", file=sys.stderr)
        return 2
    return 0


def options() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="data set with a test split")
    parser.add_argument("--restorer", default="mergenet", help="shipped weights, a weights file or a run folder")
    parser.add_argument("--cells", help="comma-separated (default all)")
    parser.add_argument("--frames", type=int, default=FRAMES, help=f"restored frames of every clip (default {FRAMES})")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results" / "restorer", help="folder of the cells")
    return parser


# ---- One cell


def measured_with(path: Path, weights: str) -> bool:
    """Return whether a cell exists whose restorer has these weights in every clip."""
    found = read_json(path) if path.exists() else {}
    clips = found.get("scores", {}).values()
    return found.get("weights") == weights and all("restorer" in clip for clip in clips)


def measured(
    clip: Clip, names: Sequence[str], light: Illumination, args: argparse.Namespace
) -> dict[str, dict[str, Any] | None]:
    """Return for each method its matched PSNR [dB], and pixels and squared error of every bin of motion.

    None for a classical method that cannot restore such codes.
    """
    codes, truth = sensed(clip, light, 0)
    peak = peak_of(truth.mean_light)
    frames = np.unique(np.linspace(0, len(truth) - 1, args.frames + 2).round().astype(int)[1:-1]).tolist()
    target = np.stack([truth.sharp(t) for t in frames]) / peak
    parts = [truth.known(t, t + 1) for t in frames]
    valid = None if parts[0] is None else np.concatenate([part for part in parts if part is not None])
    moves = [speeds(truth, range(t, t + 1)) for t in frames]
    speed = np.concatenate([move for move in moves if move is not None]) if truth.has_truth else None
    found: dict[str, dict[str, Any] | None] = {}
    for name in names:
        method = restorer(args.restorer if name == "restorer" else name)
        try:
            restored = np.concatenate([method.restore(codes, t, t + 1) for t in frames]) / peak
        except ValueError:
            if method.learned:
                raise
            found[name] = None
            continue
        score = metrics.score(restored, target, valid=valid)
        row: dict[str, Any] = {"psnr": score.psnr_matched, "raw": score.psnr, "scale": score.scale}
        if speed is not None:
            row["pixels"], row["squares"] = by_motion(restored * score.scale, target, speed)
        found[name] = row
    return found


# ---- Tables


def write_tables(out: Path, names: Sequence[str], clips: Sequence[str]) -> None:
    """Write OUT.md and OUT.png from the cells that hold all clips."""
    found = [read_json(path) for name in names if (path := out / f"{name}.json").exists()]
    cells = [cell for cell in found if set(cell["scores"]) == set(clips)]
    if not cells:
        return
    rows = [(cell["name"], *compared(cell)) for cell in cells]
    gains = [own - rival for _, own, _, rival, _ in rows]
    lost = [name for (name, *_), gain in zip(rows, gains, strict=True) if gain < 0]
    title = "The restorer against every classical method"
    clips_of = " on the clips of `scenes/restorer_test.toml`"
    text = result_page.head(title, "restorer_grid.py out/restorer_test", clips_of)
    text += [
        f"Matched PSNR in dB, peak 2.5 times the mean light, mean over {len(clips)} clips, "
        f"{cells[0]['frames']} frames of each. Weights: {cells[0]['weights'][:12]}.",
        "",
    ]
    text += [
        f"Mean over {len(rows)} cells: {np.mean(gains):+.2f} dB. Least: {min(gains):+.2f} dB. Below the best "
        f"classical method: {', '.join(lost) or 'no cell'}.",
        "",
    ]
    apart = np.array([gain for cell in cells for gain in by_clip(cell)])
    text += [
        f"By single clips: in {np.sum(apart < 0)} of {len(apart)} pairs of cell and clip the best of all "
        f"classical methods is better, by {max(0, -apart.min()):.2f} dB at most. Giving exactly these pairs "
        f"to that method would gain {np.mean(np.maximum(-apart, 0)):.2f} dB in the mean.",
        "",
    ]
    table = [
        (name, f"{own:.2f}", f"{best} {rival:.2f}", f"{own - rival:+.2f}", *(f"{x:+.2f}" for x in bins))
        for name, own, best, rival, bins in rows
    ]
    bins = tuple(f"{name} px" for name in bin_names())
    text += [*markdown_table(table, ("cell", "restorer", "best classical", "difference", *bins)), ""]
    text += [
        "Columns of motion [px/frame]: difference from the classical method that is best in the bin. "
        "Cells: sensor, bits or planes, photons per pixel and code.",
        "",
    ]
    write_bytes(out.with_suffix(".md"), "\n".join(text).encode())
    draw(dict(zip((row[0] for row in rows), gains, strict=True)), out.with_suffix(".png"))


def compared(cell: dict[str, Any]) -> tuple[float, str, float, list[float]]:
    """Return the restorer's score, the best classical method and its score, and the difference per bin of motion."""
    clips = list(cell["scores"].values())
    methods = [name for name in CLASSICAL if all(clip.get(name) for clip in clips)]
    mean = {name: float(np.mean([clip[name]["psnr"] for clip in clips])) for name in ("restorer", *methods)}
    best = max(methods, key=lambda name: mean[name])

    def bins(name: str) -> np.ndarray:
        told = [clip[name] for clip in clips if "pixels" in clip[name]]
        return np.array(pooled([row["pixels"] for row in told], [row["squares"] for row in told]))

    rivals = np.stack([bins(name) for name in methods])
    rivals = np.where(np.isnan(rivals).all(0), np.nan, np.nanmax(np.nan_to_num(rivals, nan=-math.inf), 0))
    return mean["restorer"], best, mean[best], (bins("restorer") - rivals).tolist()


def by_clip(cell: dict[str, Any]) -> list[float]:
    """Return, for each clip of a cell, the restorer's score less that of the clip's best classical method [dB]."""
    found = cell["scores"].values()
    return [
        clip["restorer"]["psnr"] - max(clip[name]["psnr"] for name in CLASSICAL if clip.get(name)) for clip in found
    ]


def draw(gains: dict[str, float], path: Path) -> None:
    """Draw the difference from the best classical method in every cell of a QIS."""
    grid = np.array([[gains.get(f"qis-{b}-{ppp:g}", math.nan) for ppp in LIGHTS] for b in BITS])
    figure = new_figure(6.5, 3.5)
    axes = figure.subplots()
    most = max(2.0, float(np.nanmax(np.abs(grid)))) if np.isfinite(grid).any() else 2.0
    shown = axes.imshow(grid, cmap="RdBu", vmin=-most, vmax=most, aspect="auto")
    for (y, x), gain in np.ndenumerate(grid):
        if math.isfinite(gain):
            shade = "white" if abs(gain) > 0.7 * most else "black"
            axes.text(x, y, f"{gain:+.1f}", ha="center", va="center", color=shade)
    axes.set_xticks(range(len(LIGHTS)), [f"{ppp:g}" for ppp in LIGHTS])
    axes.set_yticks(range(len(BITS)), [str(b) for b in BITS])
    axes.set_xlabel("photons per pixel and code")
    axes.set_ylabel("bits")
    figure.colorbar(shown, label="dB above the best classical method")
    write_figure(figure, path)


if __name__ == "__main__":
    sys.exit(main())
