"""Scores methods on mosaics: classical ones and the shipped network place by place, and a network trained on mosaics.

    qsim generate colour_training -o out/colours
    quiver train out/colours -o out/mosaic --start mergenet --crop 64 --batch 4 --steps 500 --validate-every 100
    python benchmarks/colour_rows.py out/colours out/mosaic --out docs/results/colour.json
    python benchmarks/colour_rows.py --page                          # writes docs/results/colour.md

The control is the network that the run begins from, without the learned end: each colour is restored alone, and linear
filters join them. Differences are paired over scenes, with the 95 % interval of Student's distribution.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import result_page

from qsim.dataset.dataset import Dataset
from qsim.files import VERSION, write_json
from qsim.tables import markdown_table
from quiver.cli import main as quiver_main
from quiver.evaluation.metrics import over_scenes

ROOT = Path(__file__).parents[1]
ROWS = ROOT / "docs" / "results" / "colour.json"
PAGE = ROOT / "docs" / "results" / "colour.md"
METHODS = ("moment", "transform-denoise", "qbp-bm3d", "mergenet")
CONTROL = "mergenet"
HEAD = (
    "\n".join(result_page.head("Networks on mosaics", "colour_rows.py --page", ", which states the commands"))
    + """
{scenes} scenes of families that the training has not seen, {size}, behind an RGGB mask. `trained on mosaics` began with
the weights of `mergenet` and learned {steps} steps of {batch} windows from {clips} clips ([Colour](../colour.md)). The
others restore each colour alone, and linear filters join them. PSNR in dB after the best factor, over three bands.
"""
)


def rows_of(data: Path, run: Path) -> dict[str, Any]:
    """Return the scores of all methods on every stream of the test clips."""
    clips = Dataset.open(data).clips("test")
    found = []
    for stream in clips[0].streams:
        with tempfile.TemporaryDirectory() as place:
            table = Path(place) / "table"
            words = ["evaluate", str(data), "-o", str(table), "--stream", stream, "-q"]
            code = quiver_main([*words, "--methods", ",".join([*METHODS, str(run)])])
            assert code == 0, stream
            for line in (table / "rows.jsonl").read_text().splitlines():
                row = json.loads(line)
                method = "trained on mosaics" if row["method"] == run.name else row["method"]
                kept = {"stream": stream, "scene": row["scene"], "method": method}
                found.append(kept | {"psnr": row["score"]["psnr_matched"], "ssim": row["score"]["ssim_matched"]})
    settings = json.loads((run / "settings.json").read_text())
    about = {"steps": settings["steps"], "batch": settings["batch"], "clips": len(Dataset.open(data).clips("train"))}
    _, height, width = clips[0].shape
    return {"qsim": VERSION, "size": f"{height} x {width} px", "training": about, "rows": found}


def page(found: dict[str, Any]) -> str:
    """Return the page of the rows."""
    rows = found["rows"]
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    parts = [HEAD.format(scenes=len(scenes), size=found["size"], **found["training"])]
    for stream in dict.fromkeys(row["stream"] for row in rows):
        own = {(row["method"], row["scene"]): row for row in rows if row["stream"] == stream}
        methods = list(dict.fromkeys(method for method, _ in own))
        lines = []
        for method in methods:
            psnr = np.array([own[method, scene]["psnr"] for scene in scenes])
            control = np.array([own[CONTROL, scene]["psnr"] for scene in scenes])
            ssim = np.mean([own[method, scene]["ssim"] for scene in scenes])
            each = [f"{value:.2f}" for value in psnr]
            lines.append([method, *each, f"{psnr.mean():.2f}", f"{ssim:.3f}", _difference(method, psnr - control)])
        header = ["method", *scenes, "mean", "SSIM", f"over {CONTROL}"]
        parts += [f"## {stream}", "", *markdown_table(lines, header), ""]
    return "\n".join(parts)


def _difference(method: str, apart: np.ndarray) -> str:
    """Return the mean difference over scenes with its 95 % interval; empty for the control itself."""
    if method == CONTROL:
        return ""
    found = over_scenes(apart.tolist(), range(len(apart)))
    return f"{found.mean:+.2f} ± {found.half_width:.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", help="the generated set")
    parser.add_argument("run", type=Path, nargs="?", help="folder of the training")
    parser.add_argument("--out", type=Path, help="file of the rows")
    parser.add_argument("--page", action="store_true", help=f"write {PAGE.name} from {ROWS.name}")
    args = parser.parse_args()
    if args.page:
        PAGE.write_text(page(json.loads(ROWS.read_text())))
        return
    found = rows_of(args.data, args.run)
    print(page(found))
    if args.out:
        write_json(args.out, found)


if __name__ == "__main__":
    main()
