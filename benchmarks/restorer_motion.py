"""Measures what the true motion would bring the restorer on the street test, and which part of that it finds itself.

    qsim generate scenes/restorer_street.toml -o out/restorer_street
    python benchmarks/restorer_motion.py out/restorer_street        # docs/results/restorer_motion.json and .md
    python benchmarks/restorer_motion.py out/mine --restorer out/mine_run --out out/motion

One frame of each clip is merged without motion, along the motion that was found, and along the true flow; each by the
same weights. The true flow of a clip is composed from frame to frame, forwards and backwards.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import result_page
import torch
from numpy import ndarray as Array
from restorer_street import PLACES, Place, motion, subject
from torch import Tensor

from qsim.clip.composed_flow import composed
from qsim.files import VERSION, write_bytes, write_json
from qsim.streams.clip import Clip
from qsim.tables import markdown_table
from quiver.baselines import path_merge
from quiver.baselines.domain_tables import DomainTables, domain_tables
from quiver.baselines.information_domain import information_domain
from quiver.baselines.path_merge import Merged, Prepared
from quiver.baselines.paths.motion_paths import Moves
from quiver.baselines.paths.moved_frames import look_sharply
from quiver.data.clips import open_clips, peak_of
from quiver.data.codes import sensed
from quiver.evaluation import metrics
from quiver.model.weights import digest, load
from quiver.restoration.interface import RestoreOptions
from quiver.restoration.merging import corrected
from quiver.restoration.restorers import weights_path

ROOT = Path(__file__).parents[1]
CELLS = ("qis-3-3.25", "qis-3-26")  # of the street
MIDDLE = 6
REACH = 5  # frames before and after it
MOTIONS = ("none", "found", "true")
LEAST = 0.3  # dB that the true motion brings a clip whose part is told


@dataclass(frozen=True)
class Backwards:
    """A clip that is seen from its end: `composed` follows its points into the past."""

    clip: Clip
    last: int

    def flow(self, t: int) -> Array:
        """Return flow, float32 [2, H, W] px, to the frame before."""
        return self.clip.flow_back(self.last - t)

    def valid(self, t: int) -> Array:
        """Return bool [H, W]: whether the flow is known."""
        return np.isfinite(self.flow(t)).all(axis=0)

    def holds(self, channel: str) -> bool:
        """Return whether the clip has a channel of truth."""
        return self.clip.holds(channel)

    def body_id(self, t: int) -> Array:
        """Return the body of each pixel, int32 [H, W]."""
        return self.clip.body_id(self.last - t)

    def depth(self, t: int) -> Array:
        """Return the depth of each pixel, float32 [H, W] m."""
        return self.clip.depth(self.last - t)


def true_moves(clip: Clip, middle: int, reach: int) -> dict[int, Tensor]:
    """Return where the points of a frame are in the frames beside it: {offset: [1, 2, H, W] px (down, right)}."""
    back = Backwards(clip, middle)
    moves = {}
    for k in range(1, reach + 1):
        for offset, flow in ((k, composed(clip, middle, middle + k)[0]), (-k, composed(back, 0, k)[0])):
            moves[offset] = torch.from_numpy(np.ascontiguousarray(flow[::-1]))[None]
    return moves


def followed(window: Prepared, offsets: Sequence[int], moves: dict[int, Tensor]) -> path_merge.Follow:
    """Return what sees the frames of a window along motions that are known, `moves` of `true_moves`."""
    height, width = window.codes.shape[-2:]
    rest = torch.zeros(1, 1, 2, 3)

    def follow(places: Sequence[int]) -> tuple[Tensor, Tensor, Tensor]:
        found = []
        for i in places:
            path = moves[offsets[i]]
            rows, columns = path.shape[-2:]
            path = torch.nn.functional.pad(path, (0, width - columns, 0, height - rows), mode="replicate")
            frame = window.codes[:, i : i + 1]
            found.append(look_sharply(frame, (path, torch.zeros_like(path)), [1], window.size, rest))
        seen, inside, kept = (torch.cat(parts, dim=1) for parts in zip(*found, strict=True))
        return seen, inside, kept

    return follow


def merges(clip: Clip, codes: Array, tables: DomainTables) -> dict[str, Merged]:
    """Return the merged frame MIDDLE of a clip by each of MOTIONS; `codes` are [T, H, W]."""
    offsets = range(-REACH, REACH + 1)
    frames = torch.from_numpy(codes[MIDDLE - REACH : MIDDLE + REACH + 1])[None]
    window = path_merge.evened(path_merge.prepared(frames, tables), offsets, tables)
    shape = window.codes.shape
    still = Moves((torch.zeros(1, 2, *shape[-2:]),) * 2, torch.zeros(1, len(offsets), 2, 3))
    true = followed(window, offsets, true_moves(clip, MIDDLE, REACH))
    return {
        "none": path_merge.merge_along(window, offsets, tables, still),
        "found": path_merge.merge(window, offsets, tables),
        "true": path_merge.merge_followed(window, offsets, tables, true),
    }


def measured(clip: Clip, place: Place, network: Any) -> dict[str, float]:
    """Return the matched PSNR [dB] of a clip's frame in the middle by each of MOTIONS."""
    codes, truth = sensed(clip, place.light, 0)
    peak = peak_of(truth.mean_light)
    target = truth.sharp(MIDDLE)[None] / peak
    tables = domain_tables(information_domain(codes.sensor, codes.exposure), torch.device("cpu"))
    scores = {}
    for name, merged in merges(clip, codes.read(0, codes.shape[0]), tables).items():
        restored = corrected(network, merged, tables, RestoreOptions())[:, : target.shape[1], : target.shape[2]]
        scores[name] = float(metrics.score(restored / peak, target, valid=truth.known(MIDDLE, MIDDLE + 1)).psnr_matched)
    return scores


def page(found: dict[str, Any]) -> str:
    """Return the page of all cells."""
    text = result_page.head(
        "What the true motion would bring",
        "restorer_motion.py out/restorer_street",
        f" on the {len(next(iter(found['cells'].values())))} clips of `scenes/restorer_street.toml`",
    )
    text += [
        f"Weights {found['weights'][:12]}. Frame {MIDDLE} of each clip, matched PSNR [dB]. The part is what the found "
        "motion brings, over what the true motion brings, both over no motion; of means over clips.",
        "",
    ]
    rows = []
    for name, scores in found["cells"].items():
        none, own, true = (np.array([row[motion] for row in scores.values()]) for motion in MOTIONS)
        rows.append((name, *(f"{x.mean():.2f}" for x in (none, own, true)), share(none, own, true)))
    text += [*markdown_table(rows, ("cell", "no motion", "found", "true", "part")), "", "## Every clip", ""]
    clips = next(iter(found["cells"].values()))
    table = []
    for clip in clips:
        cells = [found["cells"][name][clip] for name in found["cells"]]
        told = [f"{row['found'] - row['none']:+.2f} of {row['true'] - row['none']:+.2f}" for row in cells]
        table.append((clip, subject(clip), motion(clip), *told))
    text += [*markdown_table(table, ("clip", "subject", "motion", *found["cells"])), ""]
    return "\n".join(text)


def share(none: Array, own: Array, true: Array) -> str:
    """Return the part of the true motion's gain that the found motion has, as text."""
    gain = float((true - none).mean())
    return f"{100 * float((own - none).mean()) / gain:.0f} %" if gain > LEAST else "–"


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="data set with a test split")
    parser.add_argument("--restorer", default="mergenet", help="shipped weights, a weights file or a run folder")
    parser.add_argument("--split", default="test", help="of the clips")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results" / "restorer_motion", help="page, no end")
    args = parser.parse_args(words)
    try:
        clips = open_clips(args.data, args.split)
        if not clips:
            raise ValueError(f"{args.data}: no finished clip in split {args.split!r}; finish `qsim generate`")
        network = load(weights_path(args.restorer))
        cells = {}
        for place in PLACES:
            if place.name in CELLS:
                cells[place.name] = {clip.name: measured(clip, place, network) for clip in clips}
        found = {"quiver": VERSION, "weights": digest(weights_path(args.restorer)), "cells": cells}
        write_json(args.out.with_suffix(".json"), found)
        write_bytes(args.out.with_suffix(".md"), page(found).encode())
    except (ValueError, OSError) as error:
        print(f"restorer_motion: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
