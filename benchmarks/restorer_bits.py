"""Finds the best bit depth for motion and light with the default restorer (`--method auto`).

    python benchmarks/restorer_bits.py   # minutes; docs/results/restorer_bits.md, .png, .json; `qsim tradeoff`
    python benchmarks/restorer_bits.py --scenes 1 --size 64 --out out/bits

    photographs that slide and hide one another -> light of 10,000 planes per second -> codes of 2^b - 1 planes each
    -> eleven codes around one instant, restored -> matched PSNR of that instant

All depths get the same light per plane and share the instant in their middle. A deeper code is exposed for longer and
read less often. Every depth is restored from eleven codes, the window of the restorer, so a shallow depth uses less
time, and less light, than a deep one. The photographs trained nothing.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import result_page
from numpy import ndarray as Array

from qsim.figures import new_figure, write_figure
from qsim.files import VERSION, write_bytes, write_json
from qsim.formats.warped_pictures import FINE, Layer, Path2D, frame
from qsim.keys import Key
from qsim.scene.textures import photograph
from qsim.studies.bit_depth.restored_bits import TABLE
from qsim.tables import markdown_table
from quiver.data.codes import Codes, array_codes
from quiver.data.illumination import Illumination
from quiver.evaluation import metrics
from quiver.model.weights import digest
from quiver.restoration.automatic import chosen
from quiver.restoration.restorers import weights_path

ROOT = Path(__file__).parents[1]
DEFAULT = ROOT / "docs" / "results" / "restorer_bits"
PLANE = 1e-4  # s
UNIT = 7  # planes of a 3-bit code, in which motion is counted
BITS = (1, 2, 3, 4, 5)
MOTION = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)  # px per 3-bit code
LIGHTS = (0.02, 0.1, 0.5, 2.0, 8.0)  # photons per pixel and plane
WINDOW = 11  # codes
EDGE = 8  # px that are not scored, where what moves comes in
PHOTOGRAPHS = ("astronaut", "rocket", "moon")


# ---- Scenes


def slide(place: tuple[float, float], motion: float, direction: float) -> Path2D:
    """Return a straight path of `motion` px per unit of time."""
    speed = (motion * float(np.sin(direction)), motion * float(np.cos(direction)))
    return Path2D(place, speed, (0.0, 0.0), 1.0, 0.0, 0.0, 0.0, 0.0)


def scene(number: int, size: int, motion: float) -> list[Layer]:
    """Return a photograph and two disks of others before it, all sliding by `motion` px per 3-bit code."""
    rng = np.random.default_rng(number)
    pictures = [photograph(name).pixels() for name in PHOTOGRAPHS]
    order = rng.permutation(len(pictures))
    found = [Layer(pictures[order[0]], None, slide((size / 2, size / 2), motion, rng.uniform(0, 2 * np.pi)))]
    for i in order[1:]:
        across = int(FINE * size * rng.uniform(0.25, 0.45))
        y, x = (int(rng.integers(0, n - across)) for n in pictures[i].shape)
        far = np.hypot(*np.mgrid[-1 : 1 : across * 1j, -1 : 1 : across * 1j])
        place = (float(rng.uniform(0.2, 0.8) * size), float(rng.uniform(0.2, 0.8) * size))
        path = slide(place, motion, rng.uniform(0, 2 * np.pi))
        found.append(Layer(pictures[i][y : y + across, x : x + across], (far < 0.95).astype(float), path))
    return found


def exposures(parts: Sequence[Layer], size: int, bits: int) -> Array:
    """Return the mean light [11, size, size] of every code; the sharp instant is the middle of the middle code."""
    planes = 2**bits - 1
    first = -(WINDOW * planes // 2)
    times = (first + np.arange(WINDOW * planes)) / UNIT
    light = np.stack([frame(parts, (size, size), time)[0] for time in times])
    return light.reshape(WINDOW, planes, size, size).mean(1)


# ---- One place


def codes_of(light: Array, ppp: float, bits: int, number: int) -> Codes:
    """Return codes of the default sensor; `light` has a mean of 1, `ppp` counts photons per plane."""
    planes = 2**bits - 1
    device = Illumination.of("quiver-physical", ppp * planes, bits).device(PLANE * planes)
    drawn = device.sample(light * ppp * planes, PLANE * planes, key=Key(number, bits))
    return array_codes(drawn, device, PLANE * planes)


def measured(number: int, size: int, motion: float) -> dict[str, Any]:
    """Return, by bits and by light, the matched PSNR [dB] and the method that `auto` took."""
    parts = scene(number, size, motion)
    sharp = frame(parts, (size, size), 0.0)[0]
    inner = (slice(None), slice(EDGE, -EDGE), slice(EDGE, -EDGE))
    found: dict[str, Any] = {}
    for bits in BITS:
        light = exposures(parts, size, bits) / sharp.mean()
        for ppp in LIGHTS:
            codes = codes_of(light, ppp, bits, number)
            method, _ = chosen("auto", codes)
            restored = method.restore(codes, WINDOW // 2, WINDOW // 2 + 1) / (2**bits - 1) / ppp
            score = metrics.score(restored[inner] / 2.5, sharp[None][inner] / sharp.mean() / 2.5)
            found[f"{bits} bits, {ppp:g} PPP"] = {"psnr": score.psnr_matched, "method": method.name}
    return found


# ---- Tables


def table_of(rows: dict[str, list[dict[str, Any]]]) -> Array:
    """Return the mean over scenes of the matched PSNR [dB], [motion, light, bits]."""
    return np.array(
        [
            [[np.mean([s[f"{b} bits, {p:g} PPP"]["psnr"] for s in rows[f"{m:g}"]]) for b in BITS] for p in LIGHTS]
            for m in MOTION
        ]
    )


def of_package(found: Array, weights: str) -> dict[str, Any]:
    """Return the table that `qsim tradeoff` quotes: dB [motion][light][bits], to 0.01 dB."""
    places = {"px": list(MOTION), "ppp": list(LIGHTS), "bits": list(BITS)}
    return places | {"weights": weights, "psnr_db": found.round(2).tolist()}


def page(found: Array, scenes: int, size: int, weights: str) -> str:
    """Return the page of all numbers."""
    best = np.take(BITS, found.argmax(-1))
    three = BITS.index(3)
    text = result_page.head("The best bit depth with the default restorer", "restorer_bits.py")
    text += [
        f"Mean over {scenes} scenes of {size} x {size} px in which photographs slide before one another; "
        f"weights {weights[:12]}. PSNR is matched, peak 2.5 times the mean light. Light is counted in photons per "
        "pixel and plane of 0.1 ms, alike for all depths, motion in px per 3-bit code.",
        "",
    ]
    header = ("px per 3-bit code", *(f"{p:g} PPP per plane" for p in LIGHTS))
    rows = [
        (f"{m:g}", *(f"{best[i, j]} ({found[i, j].max() - found[i, j, three]:.1f})" for j in range(len(LIGHTS))))
        for i, m in enumerate(MOTION)
    ]
    text += ["Best depth; in brackets what three bits lose to it [dB]:", "", *markdown_table(rows, header), ""]
    text += ["![Best bit depth over motion and light](restorer_bits.png)", "", "## All numbers", ""]
    header = ("px per 3-bit code", "PPP per plane", *(f"{b} bit [dB]" for b in BITS))
    rows = [
        (f"{m:g}", f"{p:g}", *(f"{x:.2f}" for x in found[i, j]))
        for i, m in enumerate(MOTION)
        for j, p in enumerate(LIGHTS)
    ]
    return "\n".join([*text, *markdown_table(rows, header), ""])


def draw(found: Array, path: Path) -> None:
    """Draw the best depth over motion and light, with what three bits lose to it."""
    figure = new_figure(6.5, 3.8)
    axes = figure.subplots()
    best = np.take(BITS, found.argmax(-1))
    shown = axes.imshow(best, cmap="viridis", vmin=BITS[0], vmax=BITS[-1], aspect="auto", origin="lower")
    for (i, j), bits in np.ndenumerate(best):
        lost = found[i, j].max() - found[i, j, BITS.index(3)]
        text = f"{bits}" if bits == 3 else f"{bits}\n3: {-lost:.1f} dB"
        axes.text(j, i, text, ha="center", va="center", color="black" if bits > 3 else "white")
    axes.set_xticks(range(len(LIGHTS)), [f"{p:g}" for p in LIGHTS])
    axes.set_yticks(range(len(MOTION)), [f"{m:g}" for m in MOTION])
    axes.set_xlabel("photons per pixel and plane")
    axes.set_ylabel("px per 3-bit code")
    figure.colorbar(shown, label="best bits; below it three bits beside it", ticks=BITS)
    write_figure(figure, path)


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=6, help="scenes (default 6)")
    parser.add_argument("--size", type=int, default=96, help="px, side of a frame (default 96)")
    parser.add_argument("--out", type=Path, default=DEFAULT, help="without suffix")
    args = parser.parse_args(words)
    if args.scenes < 1 or not 4 * EDGE <= args.size <= 256:
        print(f"restorer_bits: give --scenes of at least 1 and --size of {4 * EDGE} to 256", file=sys.stderr)
        return 2
    rows = {f"{m:g}": [measured(n, args.size, m) for n in range(args.scenes)] for m in MOTION}
    weights = digest(weights_path("mergenet"))
    args.out.parent.mkdir(parents=True, exist_ok=True)
    same = {"format": "quiver-restorer-bits-1", "quiver": VERSION, "weights": weights, "size": args.size}
    write_json(args.out.with_suffix(".json"), same | {"motion": rows})
    found = table_of(rows)
    write_bytes(args.out.with_suffix(".md"), page(found, args.scenes, args.size, weights).encode())
    draw(found, args.out.with_suffix(".png"))
    if args.out == DEFAULT:
        write_json(TABLE, of_package(found, weights))
    print(f"{args.out.with_suffix('.md')}: written")
    return 0


if __name__ == "__main__":
    sys.exit(main())
