"""Compares scenes made in Blender, read from glTF and rendered here, with Cycles' pictures of them.

    python benchmarks/blender_rows.py --blender PYTHON -o out/blender     # a quarter of an hour; --page writes it down
    python benchmarks/blender_rows.py --pictures out/blender              # where blender_scenes.py was run before

PYTHON is that of an environment with bpy, which blender_scenes.py alone imports. Per scene: the mean light of ours over
theirs, the difference of the pictures after one factor in dB below white, and the difference of the flow to the next
frame from Blender's vector pass, its 99th percentile over the pixels that both programs see as one surface.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import result_page
from numpy import ndarray as Array
from rows import ROOT

import qsim
from qsim.scene import read_gltf

FRAME_RATE = 100.0  # of blender_scenes.py
FRAMES = 3
PAGE = (
    "\n".join(result_page.head("Beside Blender", "blender_rows.py --page docs/results/blender.md"))
    + """
<!-- not run: needs Blender's bpy in a separate environment, and a quarter of an hour -->
```sh
python3.11 -m venv out/bpy
out/bpy/bin/pip install bpy==5.0.1 numpy
python benchmarks/blender_rows.py --blender out/bpy/bin/python -o out/blender
```

`benchmarks/blender_scenes.py` builds twenty scenes in Blender 5.0.
Blender's own exporter writes each as `.glb`, and Cycles renders three frames of it with 400 samples per pixel.
`qsim` reads the file and renders the same frames at 40 dB.

- **light** is the mean light of ours over that of Cycles, less one, clamped at white.
- **structure** is the difference of the pictures after one common factor, below white. It holds the noise of both.
- **flow** is the 99th percentile of the difference from Blender's vector pass, away from outlines.
- **fastest** is the fastest motion between two frames.

| scene | light [%] | structure [dB] | flow [px] | fastest [px] |
|---|--:|--:|--:|--:|
"""
)
EDGE = 1  # px; the vector pass mixes surfaces in pixels on an outline


def theirs(path: Path) -> tuple[Array, Array]:
    """Return luminance [H, W] and the vectors of the pass [4, H, W] of Cycles' picture."""
    import OpenEXR

    parts = OpenEXR.File(str(path), separate_channels=True).parts
    picked = {name.split(".", 1)[1]: each.pixels for part in parts for name, each in part.channels.items()}
    colours = np.stack([picked[f"Combined.{band}"] for band in "RGB"], axis=-1).astype(np.float64)
    vectors = np.stack([picked[f"Vector.{axis}"] for axis in "XYZW"])
    return colours @ (0.2126, 0.7152, 0.0722), vectors


def inner(bodies: Array) -> Array:
    """Return where a pixel and its neighbours [H, W] see one body; Blender's pass knows nothing of a background."""
    found = bodies >= 0
    for shift in range(-EDGE, EDGE + 1):
        for axis in (0, 1):
            found &= np.roll(bodies, shift, axis) == bodies
    found[[0, -1]] = False
    found[:, [0, -1]] = False
    return found


def row(name: str, folder: Path, psnr: float) -> dict[str, Any]:
    """Return how the pictures of a scene agree."""
    scene = read_gltf(folder / f"{name}.glb")
    first, _ = theirs(folder / f"{name}_0.exr")
    height, width = first.shape
    clip = qsim.render(scene, frames=FRAMES, height=height, width=width, frame_rate=FRAME_RATE, psnr=psnr)
    ratios = []
    squares = []
    apart = [0.0]
    for t in range(FRAMES):
        other, vectors = theirs(folder / f"{name}_{t}.exr")
        own = clip.radiance(t).astype(np.float64)
        white = float(np.percentile(other, 99))
        seen = np.minimum(own, white)
        wanted = np.minimum(other, white)
        ratios.append(float(seen.mean() / wanted.mean()))
        factor = float((seen * wanted).sum() / (seen * seen).sum())
        squares.append(float(np.mean((factor * seen - wanted) ** 2)) / white**2)
        if t + 1 < FRAMES:
            flow = clip.flow(t)
            kept = inner(clip.body_id(t))
            # Blender's pass points from the next frame back, in pixels, with y up.
            difference = np.hypot(flow[0] + vectors[2], flow[1] - vectors[3])
            apart.append(float(np.percentile(difference[kept], 99)))
    return {
        "mean": round(float(np.mean(ratios)) - 1, 4),
        "structure_db": round(-10 * float(np.log10(np.mean(squares))), 2),
        "flow_px": round(max(apart), 4),
        "fastest_px": round(float(max(np.hypot(*clip.flow(t)).max() for t in range(FRAMES - 1))), 2),
    }


def page(rows: dict[str, dict[str, Any]]) -> str:
    """Return the page of all rows."""
    lines = [
        f"| `{name}` | {100 * row['mean']:+.2f} | {row['structure_db']:.1f} | {row['flow_px']:.4f} | "
        f"{row['fastest_px']:.2f} |"
        for name, row in sorted(rows.items())
    ]
    return PAGE + "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blender", help="Python of an environment with bpy")
    parser.add_argument("--pictures", type=Path, help="folder of blender_scenes.py, instead of --blender")
    parser.add_argument("--samples", type=int, default=400, help="of Cycles, per pixel (default 400)")
    parser.add_argument("--psnr", type=float, default=40.0, help="of ours (default 40 dB)")
    parser.add_argument("--only", help="names with commas between them (default all)")
    parser.add_argument("-o", "--output", type=Path, help="where Cycles' pictures go (default: nowhere)")
    parser.add_argument("--page", type=Path, help="Markdown file to write, such as docs/results/blender.md")
    options = parser.parse_args()
    if (options.blender is None) == (options.pictures is None):
        parser.error("give --blender or --pictures")
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.pictures or options.output or Path(temporary)
        if options.blender:
            program = ROOT / "benchmarks" / "blender_scenes.py"
            only = ["--only", options.only] if options.only else []
            line = [options.blender, str(program), str(folder), "--samples", str(options.samples), *only]
            subprocess.run(line, check=True, stdout=subprocess.DEVNULL)
        names = sorted(path.stem for path in folder.glob("*.glb"))
        rows = {}
        for name in options.only.split(",") if options.only else names:
            rows[name] = row(name, folder, options.psnr)
            print(f"| {name} | " + " | ".join(str(value) for value in rows[name].values()) + " |", flush=True)
        if options.page:
            options.page.write_text(page(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
