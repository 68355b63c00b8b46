"""Measures what 1 % of hot pixels cost mergenet: without a map, with the scan of a recording, and with their true map.

    python benchmarks/hot_pixels.py                 # the table, half an hour on one core
    python benchmarks/hot_pixels.py --found 7       # what the scan finds, in sums of 7 planes (or of 1)
    python benchmarks/hot_pixels.py --clean 200     # false positives over so many clips without hot pixels

The camera and its scenes are those of tests/support/spad_camera.py, which shares no code with the program: sums of 7
planes of 96 x 96 pixels. A hot pixel fires 0.1 to 3 times per plane, evenly in the logarithm. PSNR is of the middle
eleven frames, after the best factor, behind a peak of 2.5 times the mean light.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy import ndarray as Array

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

import spad_camera

from qsim import BinarySPAD
from qsim.tables import markdown_table
from quiver.data.codes import Codes, array_codes, filled
from quiver.data.hot_pixels import Scan, scan
from quiver.evaluation import metrics
from quiver.restoration.interface import RestoreOptions
from quiver.restoration.restorers import restorers

SHAPE = (96, 96)
PLANES = 7  # of a code
CODES = 99
SHARE = 0.01  # of hot pixels
LIGHTS = (0.1, 0.3, 1.0, 3.0)  # photons per pixel and code
CLEAN_LIGHTS = (0.5, 2.0, 6.0)  # likewise, in clips without hot pixels
BLURS = (1.0, 0.5, 0.25)  # px, of the lens in clips without hot pixels
SENSOR = BinarySPAD(1.0, 0.0).of_planes(PLANES)
PEAK = 2.5  # of the mean light


def scenes(seed: int, blur: float = 1.0) -> dict[str, spad_camera.Scene]:
    """Return the motions of one picture, which a lens blurs by so many pixels."""
    picture = spad_camera.texture(256, seed, blur)
    return {
        "pan, 0.1 px/code": spad_camera.panned(picture, SHAPE, 0.1, 0.4 + seed),
        "pan, 0.5 px/code": spad_camera.panned(picture, SHAPE, 0.5, 1.0 + seed),
        "pan, 2 px/code": spad_camera.panned(picture, SHAPE, 2.0, 2.0 + seed),
        "turn, 0.01 rad/code": spad_camera.turned(picture, SHAPE, 0.01),
        "disc over a still picture": spad_camera.passing(picture, SHAPE, 1.0),
    }


def codes_of(scene: spad_camera.Scene, light: float, dark: Array, seed: int) -> Codes:
    """Return the codes of a camera with these dark counts."""
    taken = spad_camera.Camera(dark).codes(scene, light, CODES, PLANES, seed)
    return array_codes(taken, SENSOR, PLANES * 1e-4)


def psnr(codes: Codes, scene: spad_camera.Scene, light: float) -> float:
    """Return the PSNR [dB] of the middle frames."""
    (method,) = restorers(("mergenet",), RestoreOptions(device="cpu"))
    first = CODES // 2 - 5
    restored = method.restore(codes, first, first + 11) / (PEAK * light)
    truth = np.stack([scene(first + t + 0.5) for t in range(11)]) / PEAK
    scale = metrics.best_scale(restored, truth)
    error = (np.clip(scale * restored, 0, 1) - np.clip(truth, 0, 1)) ** 2
    return metrics.decibel(float(error.mean()))


def rows() -> Iterator[list[str]]:
    """Yield the cells of the table: motion, light, PSNR clean, and what hot pixels cost in three ways."""
    for number, light in enumerate(LIGHTS):
        for name, scene in scenes(number).items():
            hot, dark = spad_camera.hot_map(SHAPE, SHARE, number)
            clean = psnr(codes_of(scene, light, 0 * dark, number), scene, light)
            codes = codes_of(scene, light, dark, number)
            found = scan(codes)
            costs = [clean - psnr(filled(codes, bad), scene, light) for bad in (None, found.hot, hot)]
            told = f"{(found.hot & hot).sum()} of {hot.sum()}"
            false = str((found.hot & ~hot).sum())
            yield [name, f"{light:g}", f"{clean:.2f}", *(f"{cost:.2f}" for cost in costs), told, false]
            print(" | ".join([name, f"{light:g}", *(f"{cost:.2f}" for cost in costs), told, false]), file=sys.stderr)


def clean_clips(count: int) -> tuple[int, int, int]:
    """Return clips without hot pixels, those with a false positive, and the false positives in all."""
    clips = wrong = pixels = 0
    for seed in range(100, 100 + count):
        blur = BLURS[seed // 18 % len(BLURS)]
        motions = scenes(seed, blur) | {"still": spad_camera.still(spad_camera.texture(256, seed, blur), SHAPE)}
        name = list(motions)[seed % len(motions)]
        light = CLEAN_LIGHTS[seed // len(motions) % len(CLEAN_LIGHTS)]
        found: Scan = scan(codes_of(motions[name], light, np.zeros(SHAPE), seed))
        clips += 1
        wrong += bool(found.hot.any())
        pixels += int(found.hot.sum())
    return clips, wrong, pixels


def found_rows(planes: int) -> Iterator[list[str]]:
    """Yield the cells of the table of the scan: motion, light, hot pixels that are found, and false ones."""
    sensor = BinarySPAD(1.0, 0.0).of_planes(planes)
    for number, light in enumerate(LIGHTS):
        for name, scene in scenes(number).items():
            hot, dark = spad_camera.hot_map(SHAPE, SHARE, number)
            told = []
            for rate in (dark, 0 * dark):
                taken = spad_camera.Camera(rate).codes(scene, light, CODES, planes, number)
                told.append(scan(array_codes(taken, sensor, planes * 1e-4)).hot)
            bright = hot & (planes * dark > light)
            found = [f"{(told[0] & of).sum()} of {of.sum()}" for of in (hot, bright)]
            yield [name, f"{light:g}", *found, str((told[0] & ~hot).sum()), str(told[1].sum())]


def main(words: list[str]) -> None:
    if words[:1] == ["--clean"]:
        clips, wrong, pixels = clean_clips(int(words[1]))
        print(f"{clips} clips without hot pixels: {wrong} with a false positive, {pixels} pixels of {clips * 96 * 96}")
        return
    if words[:1] == ["--found"]:
        header = ("motion", "PPP", "found", "of those above the light", "false", "false without hot pixels")
        print("\n".join(markdown_table(list(found_rows(int(words[1]))), header)))
        return
    header = ("motion", "PPP", "clean, dB", "no map", "scan", "true map", "found", "false")
    print("\n".join(markdown_table(list(rows()), header)))


if __name__ == "__main__":
    main(sys.argv[1:])
