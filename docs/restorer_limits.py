"""Measures the restorer that ships where its grid does not reach: flat fields, dark counts, few frames, faulty pixels.

    python docs/restorer_limits.py                            # five minutes; docs/results/restorer_limits.md, .json
    python docs/restorer_limits.py --draws 2 --size 48 --out out/limits

Every number is a mean over draws with its standard error. Draws differ in the sensor's noise and, where something
moves, in the scene: photographs that slide (restorer_bits.py).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array
from restorer_bits import EDGE, scene

from qsim.files import VERSION, sha256, write_bytes, write_json
from qsim.formats.warped_pictures import frame
from qsim.keys import Key
from qsim.tables import markdown_table
from quiver.data.codes import Codes, array_codes, filled
from quiver.data.illumination import Illumination
from quiver.evaluation import metrics
from quiver.restoration.restorers import restorer, weights_path

ROOT = Path(__file__).parents[1]
NAME, RIVAL = "mergenet", "qbp-bm3d"
EXPOSURE = 5e-4  # s
FRAMES, MIDDLE = 11, 5
BITS = (1, 2, 3, 7)
LEVELS = (0.5, 3.25, 26.0, 100.0)  # PPP that the gain is set for
SHARES = (0.1, 1.0, 2.0)  # light of a flat field over that level
PLANES = (1.0, 5.0)  # PPP on one binary SPAD plane
DARK = (1.0, 3.25)  # PPP beside the dark counts of the published sensor
SHORT = (1, 2, 3, 4, 11)  # frames of a stream
MOTION = (0.0, 2.0, 6.0)  # px/frame
LIGHTS = (3.25, 26.0)  # PPP of what moves, 3 bits
DEFECTIVE = 0.13  # share of the pixels; half of them dead, half with the top code
FAULTS = ("black", "white")  # frames


# ---- Streams


def flat(light: Illumination, ppp: float, size: int, draw: int, frames: int = FRAMES) -> Codes:
    """Return codes of a field of `ppp` photons per pixel, seen by the sensor whose gain is that of `light`."""
    sensor = light.device(EXPOSURE)
    drawn = sensor.sample(np.full((frames, size, size), ppp), EXPOSURE, key=Key(draw, 0))
    return replace(array_codes(drawn, sensor, EXPOSURE), ppp=ppp, sensor_name=light.sensor)


def moving(motion: float, ppp: float, size: int, draw: int, frames: int = FRAMES) -> tuple[Codes, Array]:
    """Return 3-bit codes of photographs that slide, and the light [size, size] of the frame in their middle."""
    parts = scene(draw, size, motion)
    middle = frames // 2
    light = np.stack([frame(parts, (size, size), float(t - middle))[0] for t in range(frames)])
    light *= ppp / light.mean()
    sensor = Illumination("quiver-physical", ppp, 3).device(EXPOSURE)
    codes = array_codes(sensor.sample(light, EXPOSURE, key=Key(draw, 1)), sensor, EXPOSURE)
    return replace(codes, ppp=ppp), light[middle]


def exchanged(codes: Codes, values: Array) -> Codes:
    """Return the stream with other codes [T, H, W]."""
    other = array_codes(values.astype(np.uint8), codes.sensor, codes.exposure)
    return replace(other, ppp=codes.ppp, sensor_name=codes.sensor_name)


# ---- Measures


def brightness(name: str, codes: Codes, ppp: float) -> float:
    """Return the mean of the restored middle frame over the light of a flat field, without its edges."""
    middle = codes.shape[0] // 2
    restored = restorer(name).restore(codes, middle, middle + 1)[0]
    return float(restored[EDGE:-EDGE, EDGE:-EDGE].mean() / ppp)


def psnr(name: str, codes: Codes, target: Array, t: int = MIDDLE) -> float:
    """Return the PSNR [dB] of restored frame t, peak 2.5 times the mean light."""
    inner = (slice(None), slice(EDGE, -EDGE), slice(EDGE, -EDGE))
    peak = 2.5 * target.mean()
    restored = restorer(name).restore(codes, t, t + 1) / peak
    return metrics.score(restored[inner], target[None][inner] / peak).psnr


def fields(draws: int, size: int) -> dict[str, list[list[float]]]:
    """Return brightness by depth and gain, of flat fields at SHARES of the level that the gain is set for."""
    return {
        f"{bits} bit, gain of {level:g} PPP": [
            [brightness(NAME, flat(Illumination(ppp=level, bits=bits), level * k, size, n), level * k)
             for n in range(draws)]
            for k in SHARES
        ]
        for bits in BITS for level in LEVELS
    }  # fmt: skip


def planes(draws: int, size: int) -> dict[str, list[float]]:
    """Return brightness of a flat field on one binary SPAD plane, by light."""
    return {
        f"{ppp:g} PPP": [
            brightness(NAME, flat(Illumination("spad-320x240", ppp, 1), ppp, size, n), ppp) for n in range(draws)
        ]
        for ppp in PLANES
    }


def dark(draws: int, size: int) -> dict[str, list[float]]:
    """Return brightness of a flat field seen by the sensor of the published program, by method and light."""
    return {
        f"{name}, {ppp:g} PPP": [
            brightness(name, flat(Illumination("quiver-published", ppp, 3), ppp, size, n), ppp) for n in range(draws)
        ]
        for ppp in DARK
        for name in (NAME, RIVAL)
    }


def short(draws: int, size: int) -> dict[str, dict[str, list[float]]]:
    """Return, by frames of the stream, brightness of a flat field and the gain over the rival [dB] on what moves."""
    light = Illumination(ppp=3.25, bits=3)
    found = {}
    for frames in SHORT:
        streams = [moving(2.0, 3.25, size, n, frames) for n in range(draws)]
        t = frames // 2
        apart = [psnr(NAME, codes, target, t) - psnr(RIVAL, codes, target, t) for codes, target in streams]
        bright = [brightness(NAME, flat(light, 3.25, size, n, frames), 3.25) for n in range(draws)]
        found[f"{frames}"] = {"brightness": bright, "gain": apart}
    return found


def defects(draws: int, size: int) -> dict[str, dict[str, list[float]]]:
    """Return, by light and motion, the dB that defective pixels cost with their map and without it."""
    found: dict[str, dict[str, list[float]]] = {}
    for ppp in LIGHTS:
        for motion in MOTION:
            row = found[f"{ppp:g} PPP, {motion:g} px/frame"] = {"map": [], "no map": []}
            for n in range(draws):
                codes, target = moving(motion, ppp, size, n)
                chance = np.random.default_rng(n).random((size, size))
                stuck = np.where(chance < DEFECTIVE / 2, 0, codes.sensor.levels - 1)
                bad = chance < DEFECTIVE
                faulty = exchanged(codes, np.where(bad, stuck, codes.read(0, FRAMES)))
                whole = psnr(NAME, codes, target)
                row["map"].append(whole - psnr(NAME, filled(faulty, bad), target))
                row["no map"].append(whole - psnr(NAME, faulty, target))
    return found


def faults(draws: int, size: int) -> dict[str, list[float]]:
    """Return the dB that the frame before costs if it is black or white by a fault, at 2 px/frame."""
    found: dict[str, list[float]] = {}
    for fault in FAULTS:
        for ppp in LIGHTS:
            row = found[f"{fault}, {ppp:g} PPP"] = []
            for n in range(draws):
                codes, target = moving(2.0, ppp, size, n)
                values = codes.read(0, FRAMES).copy()
                values[MIDDLE - 1] = 0 if fault == "black" else codes.sensor.levels - 1
                row.append(psnr(NAME, codes, target) - psnr(NAME, exchanged(codes, values), target))
    return found


# ---- The page


def told(values: Sequence[float], digits: int) -> str:
    """Return mean and standard error."""
    return f"{np.mean(values):.{digits}f} ± {np.std(values, ddof=1) / len(values) ** 0.5:.{digits}f}"


def page(found: dict[str, Any]) -> str:
    """Return the page of what was measured."""
    text = ["# The restorer outside of its grid", "", "Made by `python docs/restorer_limits.py`.", ""]
    text += [f"Weights {found['weights'][:12]}, {found['draws']} draws of {found['size']} x {found['size']} px and "
             f"{FRAMES} frames; mean and standard error. The frame in the middle is scored, {EDGE} px from its edges. "
             "Sensor `quiver-physical` where none is named.", ""]  # fmt: skip
    text += ["## Flat fields", "", "Brightness: the mean over that of the truth.", ""]
    header = ("depth, gain", *(f"field of {k:g} of that light" for k in SHARES))
    text += markdown_table([(name, *(told(v, 3) for v in row)) for name, row in found["fields"].items()], header)
    text += ["", "One binary SPAD plane (`spad-320x240`):", ""]
    text += markdown_table([(k, told(v, 3)) for k, v in found["planes"].items()], ("field", "brightness"))
    text += ["", "## Dark counts", "", "A flat field seen by `quiver-published` at 3 bits.", ""]
    text += markdown_table([(k, told(v, 3)) for k, v in found["dark"].items()], ("method, light", "brightness"))
    text += ["", "## Few frames", "",
             f"3.25 PPP, 3 bits. The gain is over {RIVAL}, at 2 px/frame.", ""]  # fmt: skip
    rows = [(k, told(v["brightness"], 3), told(v["gain"], 2)) for k, v in found["short"].items()]
    text += markdown_table(rows, ("frames", "brightness of a flat field", "gain [dB]"))
    text += ["", "## Hot and dead pixels", "",
             f"{100 * DEFECTIVE:g} % of the pixels, half of them without codes, half with the top code, "
             "3 bits: dB that they cost.", ""]  # fmt: skip
    rows = [(k, told(v["map"], 2), told(v["no map"], 2)) for k, v in found["defects"].items()]
    text += markdown_table(rows, ("light, motion", "with the map [dB]", "without it [dB]"))
    text += [
        "",
        "## A faulty frame",
        "",
        "The frame before is black or white: dB that it costs, 3 bits, 2 px/frame.",
        "",
    ]
    text += markdown_table([(k, told(v, 2)) for k, v in found["faults"].items()], ("fault, light", "cost [dB]"))
    return "\n".join([*text, ""])


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=6, help="of each number (default 6)")
    parser.add_argument("--size", type=int, default=96, help="px, side of a frame (default 96)")
    parser.add_argument(
        "--out", type=Path, default=ROOT / "docs" / "results" / "restorer_limits", help="without suffix"
    )
    args = parser.parse_args(words)
    if args.draws < 2 or not 4 * EDGE <= args.size <= 256:
        print(f"restorer_limits: give --draws of at least 2 and --size of {4 * EDGE} to 256", file=sys.stderr)
        return 2
    parts = (fields, planes, dark, short, defects, faults)
    found = {"format": "quiver-restorer-limits-1", "quiver": VERSION, "weights": sha256(weights_path(NAME))}
    found |= {"draws": args.draws, "size": args.size}
    found |= {part.__name__: part(args.draws, args.size) for part in parts}
    args.out.parent.mkdir(parents=True, exist_ok=True)
    write_json(args.out.with_suffix(".json"), found)
    write_bytes(args.out.with_suffix(".md"), page(found).encode())
    print(f"{args.out.with_suffix('.md')}: written")
    return 0


if __name__ == "__main__":
    sys.exit(main())
