"""Checks the restorer that ships beside its grid: shifts by a pixel, real photons, and crops at four levels of light.

    python benchmarks/restorer_checks.py out/restorer_test COUNTS.npy     # docs/results/restorer_checks.md, .json, .jpg

A restorer should not depend on where the grid of pixels lies: codes shifted by one pixel are restored, and the rms
difference from the shifted result is compared with the rms error that is left. Real photons are counts [N, H, W] of a
static object: every method sees eleven frames, and the mean of the others is the truth (`quiver evaluate --static`).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import result_page
from numpy import ndarray as Array
from PIL import Image, ImageDraw

from qsim import colour
from qsim.files import VERSION, write_bytes, write_json
from qsim.streams.clip import Clip
from qsim.tables import markdown_table
from quiver.data.clips import open_clips, peak_of
from quiver.data.codes import Codes, array_codes, sensed
from quiver.data.illumination import Illumination
from quiver.data.photon_counts import Counts, read_counts
from quiver.evaluation.static_object import counted, evaluate_static, reference, seen_by
from quiver.model.weights import digest
from quiver.restoration.interface import Restorer
from quiver.restoration.restorers import restorer, restorers, weights_path

ROOT = Path(__file__).parents[1]
RIVAL = "qbp-bm3d"
CLASSICAL = ("naive", "moment", "transform-denoise", "qbp", RIVAL)
SHIFTED = (Illumination.of("quiver-physical", 3.25, 3), Illumination.of("quiver-physical", 26.0, 3))
SHOWN = (0.5, 3.25, 26.0, 100.0)  # photons per pixel, 3 bits
WINDOW = 11  # frames of real photons
SCORED = 3  # splits into those and the truth, for the scores
SPLITS = 6  # likewise, for the brightness
EDGE = 8  # px that are not compared
CAPTION = 18  # px above a crop
QUALITY = 85


# ---- Shifts


def moved(codes: Codes, first: int) -> Codes:
    """Return the codes without the last row and column, or without the first ones."""
    rows = slice(first, codes.shape[1] - 1 + first), slice(first, codes.shape[2] - 1 + first)
    return array_codes(codes.read(0, codes.shape[0])[:, *rows], codes.sensor, codes.exposure)


def shift(clip: Clip, light: Illumination, method: Restorer) -> dict[str, float]:
    """Return the rms difference of a shift by one pixel along both sides and the rms error, both over the peak."""
    codes, truth = sensed(clip, light, 0)
    peak = peak_of(truth.mean_light)
    t = len(truth) // 2
    here, there = (method.restore(moved(codes, first), t, t + 1)[0].clip(0, peak) / peak for first in (0, 1))
    target = truth.sharp(t).clip(0, peak)[:-1, :-1] / peak
    inner = (slice(EDGE, -EDGE), slice(EDGE, -EDGE))
    difference = (here[1:, 1:] - there[:-1, :-1])[inner]
    return {"difference": rms(difference), "error": rms((here - target)[inner])}


def rms(values: Array) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def shifts(clips: Sequence[Clip], names: Sequence[str]) -> dict[str, dict[str, dict[str, float]]]:
    """Return the shift of each method by light and clip."""
    return {
        f"{name}, {light.label}": {clip.name: shift(clip, light, restorer(name)) for clip in clips}
        for name in names
        for light in SHIFTED
    }


# ---- Real photons


def brightness(counts: Counts, names: Sequence[str], bits: int) -> dict[str, list[float]]:
    """Return the mean of each method's frame over that of the truth, both clamped at the peak, by split."""
    rng = np.random.default_rng(0)
    peak = peak_of(counts.light)
    methods = restorers(names)
    found: dict[str, list[float]] = {method.name: [] for method in methods}
    for _ in range(SPLITS):
        given = np.sort(rng.choice(len(counts.frames), WINDOW, replace=False))
        target, _ = reference(counts, np.setdiff1d(np.arange(len(counts.frames)), given))
        codes = counted(counts, bits, given)
        for method in methods:
            share = float(counts.shares[given[seen_by(method, WINDOW // 2)]].mean())
            light = method.restore(codes, WINDOW // 2, WINDOW // 2 + 1)[0] / share
            found[method.name].append(float(light.clip(0, peak).mean() / target.clip(0, peak).mean()))
    return found


# ---- Crops


def crops(clip: Clip, own: str) -> Image.Image:
    """Return one frame, a row for every level of light: a code, the best rival, the restorer, the truth."""
    rows = []
    for ppp in SHOWN:
        codes, truth = sensed(clip, Illumination.of("quiver-physical", ppp, 3), 0)
        peak = peak_of(truth.mean_light)
        t = len(truth) // 2
        shown = {f"{ppp:g} PPP: one frame": codes.read(t, t + 1)[0] / (codes.sensor.levels - 1.0)}
        for name in (RIVAL, own):
            shown[name] = restorer(name).restore(codes, t, t + 1)[0] / peak
        shown["truth"] = truth.sharp(t) / peak
        rows.append(np.hstack([captioned(picture, text) for text, picture in shown.items()]))
    return Image.fromarray(np.vstack(rows))


def captioned(picture: Array, text: str) -> Array:
    """Return grey values uint8 of light over the peak, with a line of text above."""
    grey = colour.tone(picture, 1.0)
    label = Image.new("L", (grey.shape[1], CAPTION), 0)
    ImageDraw.Draw(label).text((4, 3), text, fill=255)
    return np.vstack([np.asarray(label), grey])


# ---- The page


def page(found: dict[str, Any]) -> str:
    """Return the page of what was measured."""
    text = result_page.head(
        "The restorer: shifts, real photons, crops", "restorer_checks.py out/restorer_test COUNTS.npy"
    )
    text += [f"Weights {found['weights'][:12]}.", "", "## A shift by one pixel", ""]
    text += [
        "The rms difference between a shifted result and the result of shifted codes, over the rms error that is "
        f"left; mean and largest over {found['clips']} clips, frame in the middle.",
        "",
    ]
    rows = []
    for name, clips in found["shift"].items():
        shares = [one["difference"] / one["error"] for one in clips.values()]
        rows.append((name, f"{np.mean(shares):.3f}", f"{max(shares):.3f}"))
    text += [*markdown_table(rows, ("method, light", "mean", "largest")), "", "## Real photons", ""]
    photons = found["photons"]
    text += [
        f"`{photons['counts']}`, a static object: eleven frames at {photons['bits']} bits, the truth is the mean "
        f"of the others. Mean of three random splits; the variance of the truth is taken off. "
        "Brightness: the mean over that of the truth, mean and standard error over six splits.",
        "",
    ]
    told = []
    for one in photons["scores"]:
        light = np.array(photons["brightness"][one["method"]])
        matched = f"{one['psnr_matched']:.2f} ± {one['psnr_matched_spread']:.2f}"
        bright = f"{light.mean():.3f} ± {light.std(ddof=1) / len(light) ** 0.5:.3f}"
        told.append((one["method"], f"{one['psnr']:.2f}", matched, f"{one['scale']:.3f}", bright))
    text += [*markdown_table(told, ("method", "PSNR [dB]", "matched [dB]", "factor", "brightness")), "", "## Crops", ""]
    text += [f"Clip {found['shown']}, 3 bits, all panels on one tone curve.", ""]
    return "\n".join([*text, "![A frame at four levels of light](restorer_checks.jpg)", ""])


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="data set with a test split")
    parser.add_argument("counts", type=Path, help="photon counts of a static object, .npy or .npz")
    parser.add_argument("--restorer", default="mergenet", help="shipped weights, a weights file or a run folder")
    parser.add_argument("--shown", default="text_0049_x11", help="clip of the crops (default text_0049_x11)")
    parser.add_argument("--bits", type=int, default=3, help="of the real photons (default 3)")
    parser.add_argument(
        "--out", type=Path, default=ROOT / "docs" / "results" / "restorer_checks", help="without suffix"
    )
    args = parser.parse_args(words)
    try:
        clips = open_clips(args.data, "test")
        shown = [clip for clip in clips if clip.name == args.shown]
        if not shown:
            raise ValueError(
                f"{args.data}: no test clip {args.shown}; give --shown one of {', '.join(c.name for c in clips)}"
            )
        counts = read_counts(args.counts)
        names = [*CLASSICAL, args.restorer]
        scores = evaluate_static(counts, restorers(names), frames=WINDOW, bits=args.bits, splits=SCORED)
        found = {
            "format": "quiver-restorer-checks-1",
            "quiver": VERSION,
            "weights": digest(weights_path(args.restorer)),
            "clips": len(clips),
            "shift": shifts(clips, (RIVAL, args.restorer)),
            "photons": {
                "counts": args.counts.name,
                "bits": args.bits,
                "scores": [asdict(one) for one in scores],
                "brightness": brightness(counts, names, args.bits),
            },
            "shown": args.shown,
        }
        text = page(found)
        picture = crops(shown[0], args.restorer)
        args.out.parent.mkdir(parents=True, exist_ok=True)
        picture.save(args.out.with_suffix(".jpg"), quality=QUALITY)
        write_json(args.out.with_suffix(".json"), found)
        write_bytes(args.out.with_suffix(".md"), text.encode())
    except (ValueError, OSError) as error:
        print(f"restorer_checks: {error}", file=sys.stderr)
        return 2
    print(f"{args.out.with_suffix('.md')}: written")
    return 0


if __name__ == "__main__":
    sys.exit(main())
