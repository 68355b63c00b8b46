"""Times frames of clips of I2 by this program and by another checkout of it, in turn: processor time, and equal light.

    git worktree add --detach out/before REVISION
    taskset -c 0 python benchmarks/render_against.py out/before --page docs/results/render_against.md

Each run is a process of its own, which renders the first frames of a clip of `scenes/i2_2000fps.toml` into a folder,
with the budget that `qsim generate` chooses. A frame's time is that of the processor, of all threads of the process.
The first frames load and compile, and do not count. The frames of both programs are compared by their checksums.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import result_page
import rows

from qsim.files import write_bytes
from qsim.tables import markdown_table

ROOT = Path(__file__).parents[1]
THREADS = {"QSIM_THREADS": "1", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


@dataclass(frozen=True)
class Case:
    """A clip of the recipe with the budget that `qsim generate` chooses for it."""

    family: str
    seed: int
    speed: float
    samples: int
    bounces: int
    neighbours: int
    quality: str  # of the denoiser; empty: none

    @property
    def name(self) -> str:
        """The clip's name in the recipe."""
        return f"{self.family}_{self.seed:04}" + ("" if self.speed == 1 else f"_x{self.speed:g}")


CASES = (
    Case("fence", 5, 1.0, samples=8, bounces=4, neighbours=5, quality="fast"),
    Case("tumble", 0, 1.5, samples=8, bounces=4, neighbours=0, quality="balanced"),
)

# Runs in a process of its own with either program; it uses only what both have.
CHILD = """
import json, sys, time
from pathlib import Path
import qsim, scenes
from qsim.rendering.budget import Budget
from qsim.rendering.clip_rendering import render_clip
asked = json.loads(sys.argv[1])
assert Path(qsim.__file__).is_relative_to(asked["program"]), qsim.__file__
scene = scenes.load(asked["family"], seed=asked["seed"], speed=asked["speed"]).resized(*asked["size"])
marks = []
class Enough(Exception):
    pass
def progress(done, frames):
    marks.append(time.process_time())
    if done == asked["skipped"] + asked["counted"]:
        raise Enough
try:
    render_clip(scene, asked["clip"], frames=65, budget=Budget(**asked["budget"]), progress=progress)
except Enough:
    pass
journal = Path(asked["clip"] + ".part", "journal.jsonl").read_text().splitlines()
entries = {entry["t"]: entry["checksums"] for entry in map(json.loads, journal)}
spent = (marks[-1] - marks[asked["skipped"] - 1]) / asked["counted"]
print(json.dumps({"seconds": spent, "frames": [entries[t] for t in range(asked["skipped"] + asked["counted"])]}))
"""


def run(program: Path, case: Case, size: tuple[int, int], skipped: int, counted: int) -> dict[str, Any]:
    """Return the processor seconds of a frame of one program, and the checksums of the files of its frames."""
    budget = {
        "samples": case.samples,
        "bounces": case.bounces,
        "neighbours": case.neighbours,
        "denoise": bool(case.quality),
        "quality": case.quality or "high",
    }
    asked = {"family": case.family, "seed": case.seed, "speed": case.speed, "size": size, "budget": budget}
    with tempfile.TemporaryDirectory() as folder:
        asked |= {"program": str(program), "clip": str(Path(folder) / "clip"), "skipped": skipped, "counted": counted}
        child = subprocess.run(
            [sys.executable, "-c", CHILD, json.dumps(asked)],
            cwd=program,
            env=os.environ | THREADS | {"PYTHONPATH": str(program)},
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        )
    found: dict[str, Any] = json.loads(child.stdout.splitlines()[-1])
    return found


def equal_files(before: list[dict[str, str]], after: list[dict[str, str]]) -> str:
    """Return how many files of the frames are equal, as `5 of 5`."""
    pairs = [(one[name], other.get(name)) for one, other in zip(before, after, strict=True) for name in one]
    return f"{sum(one == other for one, other in pairs)} of {len(pairs)}"


def page(table: list[tuple[str, ...]], size: tuple[int, int], runs: int, frames: int, revision: str, busy: bool) -> str:
    """Return the page of all clips."""
    command = f"render_against.py FOLDER --size {size[0]} {size[1]}"
    text = result_page.head("A frame of I2 before and now", command, f"; FOLDER has revision {revision}")
    text += [
        f"Medians of {runs} runs of each program in turn, {frames} frames each. Milliseconds are those of the "
        "processor, of all threads; the ratio is that of the medians. Files are pictures and ground truth.",
        "",
    ]
    names = ("clip", "samples, neighbours, denoiser", "before [ms]", "now [ms]", "ratio", "equal files")
    text += [*markdown_table(table, names), "", f"Machine: {rows.processor()}.", ""]
    text += ["Measured beside other programs.", ""] * busy
    return "\n".join(text)


def main() -> None:
    """Print or write the page of both programs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path, help="folder of another checkout")
    parser.add_argument("--size", type=int, nargs=2, default=(512, 1024), help="rows and columns")
    parser.add_argument("--runs", type=int, default=3, help="runs of each program, in turn")
    parser.add_argument("--skipped", type=int, default=3, help="first frames that do not count")
    parser.add_argument("--frames", type=int, default=3, help="frames that count")
    parser.add_argument("--clips", default=",".join(case.name for case in CASES), help="names, with commas")
    parser.add_argument("--busy", action="store_true", help="say that other programs ran beside")
    parser.add_argument("--page", type=Path, help="file to write")
    asked = parser.parse_args()
    if not (asked.before / "qsim").is_dir():
        parser.error(f"{asked.before}: not a checkout of this program, as it has no folder qsim")
    programs = {"before": asked.before.resolve(), "now": ROOT}
    table: list[tuple[str, ...]] = []
    for case in CASES:
        if case.name not in asked.clips.split(","):
            continue
        found: dict[str, list[dict[str, Any]]] = {name: [] for name in programs}
        for _ in range(asked.runs):
            for name, program in programs.items():
                found[name].append(run(program, case, tuple(asked.size), asked.skipped, asked.frames))
                print(case.name, name, f"{found[name][-1]['seconds']:.3f} s", file=sys.stderr, flush=True)
        before, now = (median(each["seconds"] for each in found[name]) for name in programs)
        equal = equal_files(*(found[name][0]["frames"] for name in programs))
        budget = f"{case.samples}, {case.neighbours}, {case.quality or 'off'}"
        table.append((case.name, budget, f"{1e3 * before:.0f}", f"{1e3 * now:.0f}", f"{before / now:.2f}", equal))
    revision = subprocess.run(
        ["git", "-C", str(programs["before"]), "rev-parse", "--short=8", "HEAD"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout.strip()
    content = page(table, tuple(asked.size), asked.runs, asked.frames, revision, asked.busy)
    if asked.page is None:
        print(content)
    else:
        write_bytes(asked.page, content.encode())


if __name__ == "__main__":
    main()
