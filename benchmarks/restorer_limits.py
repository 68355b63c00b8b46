"""Measures the restorer that ships where its grid does not reach: flat fields, few frames, faults, light that changes.

    python benchmarks/restorer_limits.py                  # a quarter of an hour; docs/results/restorer_limits.md, .json
    python benchmarks/restorer_limits.py --draws 2 --size 48 --out out/limits

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
import result_page
from numpy import ndarray as Array
from restorer_bits import EDGE, scene

from qsim.files import VERSION, write_bytes, write_json
from qsim.formats.warped_pictures import frame
from qsim.keys import Key
from qsim.tables import markdown_table
from quiver.data.codes import Codes, array_codes, filled
from quiver.data.illumination import Illumination
from quiver.evaluation import metrics
from quiver.model.weights import digest
from quiver.restoration.domain import light_change
from quiver.restoration.restorers import restorer, weights_path

ROOT = Path(__file__).parents[1]
NAME = "mergenet"
RIVAL = "qbp-bm3d"
EXPOSURE = 5e-4  # s
FRAMES = 11
MIDDLE = 5
LONG = 21  # frames of a stream whose middle frame becomes the first one
BITS = (1, 2, 3, 7)
LEVELS = (0.5, 3.25, 26.0, 100.0)  # PPP that the gain is set for
SHARES = (0.1, 1.0, 2.0)  # light of a flat field over that level
PLANES = (1.0, 5.0)  # PPP on one binary SPAD plane
DARK = (1.0, 3.25)  # PPP beside the dark counts of the published sensor
TEXTURES = (0.5, 3.0, 30.0)  # PPP of photographs whose mean light is compared, 3 bits
SHORT = (1, 2, 3, 4, 6, 11)  # frames of a stream
SEEN = (("quiver-physical", 3.25, 3), ("quiver-physical", 0.5, 3), ("spad-320x240", 1.0, 1))  # by short streams
MOTION = (0.0, 2.0, 6.0)  # px/frame
LIGHTS = (3.25, 26.0)  # PPP of what moves, 3 bits
DEFECTIVE = 0.13  # share of the pixels; half of them dead, half with the top code
FAULTS = ("black", "white")  # frames
CHANGES = (0.0, 0.1, 0.2, 0.4, 0.8)  # of the light from the first to the last of eleven frames, over its mean
SLOW = (0.0, 2.0)  # px/frame of what moves in light that changes
CLASSICAL = ("moment", "qbp", "qbp-bm3d")  # beside which patterns and points are restored
CONTRAST = 0.8  # of patterns
CHECKS = (1, 2)  # px, side of a square of a still checkerboard
STRIPES = (2, 4)  # px, width of a stripe
SPEEDS = (0, 1, 3)  # px/frame of stripes and points
POINTS = ((0.5, 20.0), (3.0, 8.0))  # photons of the ground, and what single pixels add to it
RARE = 0.01  # share of such pixels


# ---- Streams


def flat(light: Illumination, ppp: float, size: int, draw: int, frames: int = FRAMES) -> Codes:
    """Return codes of a field of `ppp` photons per pixel, seen by the sensor whose gain is that of `light`."""
    sensor = light.device(EXPOSURE)
    drawn = sensor.sample(np.full((frames, size, size), ppp), EXPOSURE, key=Key(draw, 0))
    return replace(array_codes(drawn, sensor, EXPOSURE), ppp=ppp, sensor_name=light.sensor)


def moving(
    motion: float, ppp: float, size: int, draw: int, frames: int = FRAMES, change: float = 0.0
) -> tuple[Codes, Array]:
    """Return 3-bit codes of photographs that slide, and the light [size, size] of the frame in their middle.

    Their light rises from the first to the last frame by `change` of its mean.
    """
    parts = scene(draw, size, motion)
    middle = frames // 2
    light = np.stack([frame(parts, (size, size), float(t - middle))[0] for t in range(frames)])
    light *= (ppp / light.mean() * (1 + change * np.linspace(-0.5, 0.5, frames)))[:, None, None]
    return codes_of(light, ppp, draw), light[middle]


def codes_of(light: Array, ppp: float, draw: int) -> Codes:
    """Return 3-bit codes of light [T, H, W] seen by the sensor whose gain is that of `ppp`."""
    sensor = Illumination.of("quiver-physical", ppp, 3).device(EXPOSURE)
    codes = array_codes(sensor.sample(light, EXPOSURE, key=Key(draw, 1)), sensor, EXPOSURE)
    return replace(codes, ppp=ppp)


def sliding(picture: Array, speed: int) -> Array:
    """Return frames of a picture [H, W] that slides round by whole pixels, in place in the middle."""
    return np.stack([np.roll(picture, speed * (t - MIDDLE), axis=1) for t in range(FRAMES)])


def patterns(size: int) -> dict[str, Array]:
    """Return name -> frames of checkerboards and stripes, of mean 1."""
    y, x = np.mgrid[:size, :size]
    found = {f"checkerboard of {k} px, still": sliding((y // k + x // k) % 2, 0) for k in CHECKS}
    for width in STRIPES:
        found |= {f"stripes of {width} px, {v} px/frame": sliding(x // width % 2, v) for v in SPEEDS}
    return {name: 1 + CONTRAST * (2.0 * frames - 1) for name, frames in found.items()}


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
            [
                brightness(NAME, flat(Illumination.of(ppp=level, bits=bits), level * k, size, n), level * k)
                for n in range(draws)
            ]
            for k in SHARES
        ]
        for bits in BITS
        for level in LEVELS
    }


def planes(draws: int, size: int) -> dict[str, list[float]]:
    """Return brightness of a flat field on one binary SPAD plane, by light."""
    return {
        f"{ppp:g} PPP": [
            brightness(NAME, flat(Illumination.of("spad-320x240", ppp, 1), ppp, size, n), ppp) for n in range(draws)
        ]
        for ppp in PLANES
    }


def dark(draws: int, size: int) -> dict[str, list[float]]:
    """Return brightness of a flat field seen by the sensor of the published program, by method and light."""
    return {
        f"{name}, {ppp:g} PPP": [
            brightness(name, flat(Illumination.of("quiver-published", ppp, 3), ppp, size, n), ppp) for n in range(draws)
        ]
        for ppp in DARK
        for name in (NAME, RIVAL)
    }


def textures(draws: int, size: int) -> dict[str, list[float]]:
    """Return the mean of the restored middle frame over that of its truth, of photographs, by light and motion."""
    found: dict[str, list[float]] = {}
    inner = (slice(EDGE, -EDGE), slice(EDGE, -EDGE))
    for ppp in TEXTURES:
        for motion in MOTION:
            row = found[f"{ppp:g} PPP, {motion:g} px/frame"] = []
            for n in range(draws):
                codes, target = moving(motion, ppp, size, n)
                restored = restorer(NAME).restore(codes, MIDDLE, MIDDLE + 1)[0]
                row.append(float(restored[inner].mean() / target[inner].mean()))
    return found


def ends(draws: int, size: int) -> dict[str, dict[str, list[float]]]:
    """Return the dB that the frames before cost if they lack, by light and motion, of the restorer and the rival."""
    found: dict[str, dict[str, list[float]]] = {}
    for ppp in LIGHTS:
        for motion in MOTION:
            row = found[f"{ppp:g} PPP, {motion:g} px/frame"] = {NAME: [], RIVAL: []}
            for n in range(draws):
                codes, target = moving(motion, ppp, size, n, LONG)
                begun = exchanged(codes, codes.read(LONG // 2, LONG))
                for name, lost in row.items():
                    lost.append(psnr(name, codes, target, LONG // 2) - psnr(name, begun, target, 0))
    return found


def short(draws: int, size: int) -> dict[str, dict[str, Any]]:
    """Return, by frames of the stream, brightness of flat fields and the gain over the rival [dB] on what moves."""
    lights = [Illumination.of(*seen) for seen in SEEN]
    found = {}
    for frames in SHORT:
        streams = [moving(2.0, 3.25, size, n, frames) for n in range(draws)]
        t = frames // 2
        apart = [psnr(NAME, codes, target, t) - psnr(RIVAL, codes, target, t) for codes, target in streams]
        bright = [
            [brightness(NAME, flat(light, light.ppp or 0, size, n, frames), light.ppp or 0) for n in range(draws)]
            for light in lights
        ]
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


def changing(draws: int, size: int) -> dict[str, dict[str, list[float]]]:
    """Return, by light, motion and change of light, the gain over the rival [dB] and the change that is found."""
    found: dict[str, dict[str, list[float]]] = {}
    for ppp in LIGHTS:
        for motion in SLOW:
            for change in CHANGES:
                streams = [moving(motion, ppp, size, n, change=change) for n in range(draws)]
                gain = [psnr(NAME, codes, target) - psnr(RIVAL, codes, target) for codes, target in streams]
                found[f"{ppp:g} PPP, {motion:g} px/frame, {100 * change:g} %"] = {
                    "gain": gain,
                    "found": [light_change(codes) for codes, _ in streams],
                }
    return found


def details(draws: int, size: int) -> dict[str, dict[str, list[float]]]:
    """Return PSNR [dB] by method of fine patterns, and of points on a dark ground."""
    cases = {
        f"{name}, {ppp:g} PPP": [(ppp * frames, ppp)] * draws
        for ppp in LIGHTS
        for name, frames in patterns(size).items()
    }
    for ground, more in POINTS:
        for speed in SPEEDS:
            rare = [np.random.default_rng(n).random((size, size)) < RARE for n in range(draws)]
            seen = [sliding(ground + more * places, speed) for places in rare]
            cases[f"points of {more:g} on {ground:g} photons, {speed} px/frame"] = [(x, float(x.mean())) for x in seen]
    found: dict[str, dict[str, list[float]]] = {}
    for name, lights in cases.items():
        streams = [(codes_of(light, ppp, n), light[MIDDLE]) for n, (light, ppp) in enumerate(lights)]
        found[name] = {method: [psnr(method, *stream) for stream in streams] for method in (NAME, *CLASSICAL)}
    return found


# ---- The page


def told(values: Sequence[float], digits: int) -> str:
    """Return mean and standard error."""
    return f"{np.mean(values):.{digits}f} ± {np.std(values, ddof=1) / len(values) ** 0.5:.{digits}f}"


def page(found: dict[str, Any]) -> str:
    """Return the page of what was measured."""
    text = result_page.head("The restorer outside of its grid", "restorer_limits.py")
    text += [
        f"Weights {found['weights'][:12]}, {found['draws']} draws of {found['size']} x {found['size']} px and "
        f"{FRAMES} frames; mean and standard error. The frame in the middle is scored, {EDGE} px from its edges. "
        "Sensor `quiver-physical` where none is named.",
        "",
    ]
    text += ["## Flat fields", "", "Brightness: the mean over that of the truth.", ""]
    header = ("depth, gain", *(f"field of {k:g} of that light" for k in SHARES))
    text += markdown_table([(name, *(told(v, 3) for v in row)) for name, row in found["fields"].items()], header)
    text += ["", "One binary SPAD plane (`spad-320x240`):", ""]
    text += markdown_table([(k, told(v, 3)) for k, v in found["planes"].items()], ("field", "brightness"))
    text += ["", "## Dark counts", "", "A flat field seen by `quiver-published` at 3 bits.", ""]
    text += markdown_table([(k, told(v, 3)) for k, v in found["dark"].items()], ("method, light", "brightness"))
    text += ["", "## Textures", "", "Photographs that slide, 3 bits: brightness.", ""]
    text += markdown_table([(k, told(v, 3)) for k, v in found["textures"].items()], ("light, motion", "brightness"))
    text += ["", "## The first frame", "", "dB that it costs a frame to be the first of its stream, 3 bits.", ""]
    rows = [(k, *(told(v[name], 2) for name in (NAME, RIVAL))) for k, v in found["ends"].items()]
    text += markdown_table(rows, ("light, motion", NAME, RIVAL))
    text += ["", "## Few frames", "", f"The gain is over {RIVAL}, at 3.25 PPP, 3 bits, 2 px/frame.", ""]
    rows = [(k, *(told(x, 3) for x in v["brightness"]), told(v["gain"], 2)) for k, v in found["short"].items()]
    header = ("frames", *(f"brightness, {sensor}, {bits} bit, {ppp:g} PPP" for sensor, ppp, bits in SEEN), "gain [dB]")
    text += markdown_table(rows, header)
    text += [
        "",
        "## Hot and dead pixels",
        "",
        f"{100 * DEFECTIVE:g} % of the pixels, half of them without codes, half with the top code, "
        "3 bits: dB that they cost.",
        "",
    ]
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
    text += [
        "",
        "## Light that changes",
        "",
        f"3 bits; the light rises steadily over {FRAMES} frames. The gain is over {RIVAL}. The change that is "
        "found in the codes alone leaves out what noise may explain (quiver/restoration/domain.py).",
        "",
    ]
    rows = [(k, told(v["gain"], 2), f"{100 * np.mean(v['found']):.0f} %") for k, v in found["changing"].items()]
    text += markdown_table(rows, ("light, motion, change", "gain [dB]", "change found"))
    text += [
        "",
        "## Fine patterns and points",
        "",
        f"3 bits; patterns of contrast {CONTRAST:g}, points in {100 * RARE:g} % of the pixels. PSNR in dB.",
        "",
    ]
    methods = (NAME, *CLASSICAL)
    rows = [(k, *(told(v[method], 1) for method in methods)) for k, v in found["details"].items()]
    text += markdown_table(rows, ("picture", *methods))
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
    parts = (fields, planes, dark, textures, ends, short, defects, faults, changing, details)
    found = {"format": "quiver-restorer-limits-3", "quiver": VERSION, "weights": digest(weights_path(NAME))}
    found |= {"draws": args.draws, "size": args.size}
    found |= {part.__name__: part(args.draws, args.size) for part in parts}
    args.out.parent.mkdir(parents=True, exist_ok=True)
    write_json(args.out.with_suffix(".json"), found)
    write_bytes(args.out.with_suffix(".md"), page(found).encode())
    print(f"{args.out.with_suffix('.md')}: written")
    return 0


if __name__ == "__main__":
    sys.exit(main())
