"""Scores the restorer that ships on the street test, and writes the page with its mean, interval and worst clip.

    qsim generate scenes/restorer_street.toml -o out/restorer_street
    python benchmarks/restorer_street.py out/restorer_street                              # what is missing
    python benchmarks/restorer_street.py out/restorer_street --out out/mine --restorer out/mine_run

A cell is RESULTS/NAME.json, one sensor, bit depth and light. It grows by clips and methods; with other weights only
the restorer is measured again. The rival of a clip is the classical method that is best on this clip, which no stream
knows. Consecutive frames are scored, so that flicker is seen, too.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import restorer_cells
import result_page
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from restorer_cells import RESTORER, Place
from scipy.stats import t as student

from qsim.colour import tone
from qsim.files import write_bytes
from qsim.scenes.street import motion_of, subject_of
from qsim.streams.clip import Clip
from qsim.tables import markdown_table
from quiver.data.clips import open_clips, peak_of
from quiver.data.codes import Codes, sensed
from quiver.data.illumination import Illumination
from quiver.evaluation import metrics
from quiver.restoration.automatic import NETWORK, chosen
from quiver.restoration.restorers import restorer

ROOT = Path(__file__).parents[1]
FORMAT = "quiver-restorer-street-1"
CLASSICAL = ("qbp", "qbp-bm3d:5", "qbp-bm3d")
FRAMES = range(6, 8)  # of fourteen: the two in the middle; their windows of eleven are complete
LOST = 0.3  # dB below the best classical method of a clip, from which a clip counts as lost
SHOWN = "qis-3-3.25"  # the cell of the pictures, and of the tables by subject and motion
PICTURES = 3  # clips with the least lead, and with the largest
PSNR = "psnr"

Row = dict[str, float]


PLACES = tuple(
    Place(f"qis-{bits}-{ppp:g}", Illumination.of("quiver-physical", ppp, bits))
    for bits, ppp in ((1, 1.0), (3, 0.5), (3, 3.25), (3, 26.0))
)


def main(words: list[str] | None = None) -> int:
    args = options().parse_args(words)
    try:
        clips = open_clips(args.data, "test")
        if not clips:
            raise ValueError(f"{args.data}: no finished clip in split 'test'; finish `qsim generate`")
        args.out.mkdir(parents=True, exist_ok=True)
        cells = [grown(args.out / f"{place.name}.json", place, clips, args.restorer) for place in PLACES]
        if args.pictures:
            write_pictures(args.out.with_suffix(".jpg"), cells, clips, args.restorer)
        write_page(args.out.with_suffix(".md"), cells)
    except (ValueError, OSError) as error:
        print(f"restorer_street: {error}", file=sys.stderr)
        return 2
    return 0


def options() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="data set with a test split")
    parser.add_argument("--restorer", default="mergenet", help="shipped weights, a weights file or a run folder")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results" / "restorer_street", help="cells")
    parser.add_argument(
        "--pictures", action="store_true", help="draw the clips with the least and the largest lead, too"
    )
    return parser


# ---- One cell


def grown(path: Path, place: Place, clips: Sequence[Clip], weights: str) -> dict[str, Any]:
    """Return a cell after what it lacked was measured; `ValueError` if it was measured otherwise."""
    measure = partial(measured, light=place.light, weights=weights)
    return restorer_cells.grow(path, clips, weights, CLASSICAL, measure, format=FORMAT, frames=len(FRAMES))


def measured(clip: Clip, names: Sequence[str], light: Illumination, weights: str) -> dict[str, Any]:
    """Return for each method its scores, and the method that `auto` chooses, by name.

    The choice is that for a longer stream: fourteen frames are too few for a trial that costs a tenth of them.
    """
    codes, truth = sensed(clip, light, 0)
    peak = peak_of(truth.mean_light)
    target = np.stack([truth.sharp(t) for t in FRAMES]) / peak
    parts = [truth.known(t, t + 1) for t in FRAMES]
    valid = None if parts[0] is None else np.concatenate([part for part in parts if part is not None])
    found: dict[str, Any] = {}
    for name in names:
        restored = restore(weights if name == RESTORER else name, codes) / peak
        score = metrics.score(restored, target, valid=valid)
        found[name] = {
            PSNR: score.psnr_matched,
            "ssim": score.ssim_matched,
            "scale": score.scale,
            "flicker": flicker(restored * score.scale, target),
        }
    if RESTORER in names:
        found["auto"] = chosen("auto", codes, cost=math.inf)[0].name
    return found


def restore(name: str, codes: Codes) -> NDArray[np.float32]:
    """Return the scored frames by a method, photons [T, H, W]."""
    method = restorer(name)
    return np.concatenate([method.restore(codes, t, t + 1) for t in FRAMES])


def flicker(restored: NDArray[np.floating], target: NDArray[np.floating]) -> float:
    """Return how the error changes from frame to frame, the root of its mean square in units of the peak."""
    error = np.clip(restored, 0, 1) - np.clip(target, 0, 1)
    return float(np.sqrt(np.mean(np.diff(error, axis=0) ** 2)))


# ---- The page


def lead(rows: dict[str, Any], method: str = RESTORER) -> float:
    """Return the PSNR of a method less that of the classical method that is best on this clip [dB]."""
    return float(rows[method][PSNR] - max(rows[name][PSNR] for name in CLASSICAL))


def mean_with_interval(values: Iterable[float]) -> tuple[float, float]:
    """Return a mean and the half-width of its 95 % interval by Student's t; NaN for one value."""
    found = np.array(list(values))
    if len(found) < 2:
        return float(found.mean()), math.nan
    return float(found.mean()), float(student.ppf(0.975, len(found) - 1) * found.std(ddof=1) / math.sqrt(len(found)))


def best_of_all(scores: dict[str, Any]) -> str:
    """Return the classical method with the best mean over the clips of a cell."""
    return max(CLASSICAL, key=lambda name: float(np.mean([rows[name][PSNR] for rows in scores.values()])))


def seed_of(clip: str) -> int:
    """Return the seed in the name of a clip of the family, street_0041_x4."""
    return int(clip.split("_")[1])


def subject(clip: str) -> str:
    """Return what a clip shows."""
    return subject_of(seed_of(clip))


def motion(clip: str) -> str:
    """Return how the camera of a clip moves."""
    return motion_of(seed_of(clip))


def write_page(path: Path, cells: Sequence[dict[str, Any]]) -> None:
    """Write the page of all cells."""
    clips = list(cells[0]["scores"])
    text = result_page.head(
        "The restorer on the street",
        "restorer_street.py out/restorer_street --pictures",
        " on the thirty clips of `scenes/restorer_street.toml`",
    )
    text += [
        f"Matched PSNR, peak 2.5 times the mean light, {cells[0]['frames']} consecutive frames of each of {len(clips)} "
        f"clips. Weights: {cells[0]['weights'][:12]}. The rival of a clip is the best of {', '.join(CLASSICAL)} on "
        "this clip. The interval is Student's 95 % over clips. A clip is lost where the rival is more than "
        f"{LOST:g} dB better.",
        "",
        *headline(cells),
        "",
        "## Quality beside PSNR",
        "",
        "SSIM after the factor of the matched PSNR. Flicker: root mean square of the change of the error from frame to "
        "frame, in thousandths of the peak. The classical method is the best one in the mean of the cell.",
        "",
        *quality(cells),
        "",
    ]
    shown = next(cell for cell in cells if cell["name"] == SHOWN)
    for title, group in (("By subject", subject), ("By motion", motion)):
        text += [f"## {title}, at 3 bits and 3.25 PPP", "", *grouped(shown, group), ""]
    text += ["## Every clip", "", *every_clip(cells), ""]
    if path.with_suffix(".jpg").exists():
        text += [
            f"The {PICTURES} clips on which its lead is least and the {PICTURES} on which it is largest, at 3 bits and "
            "3.25 PPP: truth, codes, the best classical method, the restorer.",
            "",
            f"![Crops of the street test]({path.with_suffix('.jpg').name})",
            "",
        ]
    write_bytes(path, "\n".join(text).encode())


def headline(cells: Sequence[dict[str, Any]]) -> list[str]:
    """Return the table of leads, and of what `auto` gives."""
    table = []
    for cell in cells:
        scores = cell["scores"]
        leads = {clip: lead(rows) for clip, rows in scores.items()}
        mean, half = mean_with_interval(leads.values())
        worst = min(leads, key=lambda clip: leads[clip])
        best = best_of_all(scores)
        over_one = [rows[RESTORER][PSNR] - rows[best][PSNR] for rows in scores.values()]
        auto = [lead(rows, RESTORER if rows["auto"] == NETWORK else rows["auto"]) for rows in scores.values()]
        table.append(
            (
                cell["name"],
                f"{np.mean([rows['restorer'][PSNR] for rows in scores.values()]):.2f}",
                f"{mean:+.2f} ± {half:.2f}",
                f"{leads[worst]:+.2f} ({subject(worst)}, {motion(worst)})",
                str(sum(value < -LOST for value in leads.values())),
                f"{np.mean(over_one):+.2f} ({best})",
                str(sum(value < -LOST for value in auto)),
            )
        )
    heads = ("cell", "restorer", "lead", "worst clip", "lost", "lead over one method", "lost by `auto`")
    return list(markdown_table(table, heads))


def quality(cells: Sequence[dict[str, Any]]) -> list[str]:
    """Return SSIM and flicker of the restorer and of the best classical method."""
    table = []
    for cell in cells:
        best = best_of_all(cell["scores"])
        for name in (RESTORER, best):
            rows = [scores[name] for scores in cell["scores"].values()]
            table.append(
                (
                    cell["name"],
                    name,
                    f"{np.mean([row[PSNR] for row in rows]):.2f}",
                    f"{np.mean([row['ssim'] for row in rows]):.3f}",
                    f"{1000 * np.mean([row['flicker'] for row in rows]):.1f}",
                )
            )
    return list(markdown_table(table, ("cell", "method", "PSNR matched", "SSIM", "flicker")))


def grouped(cell: dict[str, Any], group: Callable[[str], str]) -> list[str]:
    """Return the mean and least lead of each group of clips."""
    found: dict[str, list[float]] = {}
    for clip, rows in cell["scores"].items():
        found.setdefault(group(clip), []).append(lead(rows))
    table = [(name, str(len(leads)), f"{np.mean(leads):+.2f}", f"{min(leads):+.2f}") for name, leads in found.items()]
    return list(markdown_table(sorted(table), ("", "clips", "mean lead", "least lead")))


def every_clip(cells: Sequence[dict[str, Any]]) -> list[str]:
    """Return the lead on every clip in every cell."""
    table = [
        (clip, subject(clip), motion(clip), *(f"{lead(cell['scores'][clip]):+.2f}" for cell in cells))
        for clip in sorted(cells[0]["scores"])
    ]
    return list(markdown_table(table, ("clip", "subject", "motion", *(cell["name"] for cell in cells))))


def write_pictures(path: Path, cells: Sequence[dict[str, Any]], clips: Sequence[Clip], weights: str) -> None:
    """Draw one frame of the clips with the least and the largest lead."""
    scores = next(cell for cell in cells if cell["name"] == SHOWN)["scores"]
    light = next(place.light for place in PLACES if place.name == SHOWN)
    ranked = sorted(scores, key=lambda clip: lead(scores[clip]))
    drawn = []
    for name in [*ranked[:PICTURES], *ranked[-PICTURES:]]:
        codes, truth = sensed(next(clip for clip in clips if clip.name == name), light, 0)
        rival = max(CLASSICAL, key=lambda method: scores[name][method][PSNR])
        frame = FRAMES[1]
        sharp = truth.sharp(frame)
        white = float(np.percentile(sharp, 99.0))
        counts = codes.read(frame, frame + 1)[0].astype(np.float64)
        noisy = counts * (sharp.mean() / max(counts.mean(), 1e-9))
        restored = [restorer(method).restore(codes, frame, frame + 1)[0] for method in (rival, weights)]
        tiles = [tone(picture, white) for picture in (sharp, noisy, *restored)]
        pictures = np.hstack(tiles)
        line = Image.new("L", (pictures.shape[1], 14), 255)
        text = f"{subject(name)}, {motion(name)}: {lead(scores[name]):+.1f} dB above {rival}"
        ImageDraw.Draw(line).text((3, 1), text, fill=0)
        drawn += [np.asarray(line), pictures]
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.vstack(drawn)).save(path, quality=80)


if __name__ == "__main__":
    sys.exit(main())
