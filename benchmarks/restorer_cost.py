"""Times the restorer that ships beside QBP + BM3D, in turn and in one run.

    python benchmarks/restorer_cost.py                 # docs/results/restorer_cost.md; about six minutes of quiet cores

Both restore eleven frames of 512 x 1024: a photograph that slides by 2 px/frame, 3 bits, 3.25 PPP, with the threads
of their defaults. Each program is a separate process that stays, their runs alternate, and the first ones are not
counted. Last, `quiver restore` restores such frames from a file: the most memory of its complete process.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

import numpy as np
import result_page
import rows
from skimage import data

from qsim.files import write_bytes
from qsim.keys import Key
from qsim.sensor.devices import quiver_physical
from qsim.tables import markdown_table

ROOT = Path(__file__).parents[1]
FRAMES = 11
COMMAND = """
import sys
from qsim.process import peak_memory
from quiver.cli.program import main
code = main(sys.argv[1:])
print(peak_memory())
sys.exit(code)
"""

LIGHT = """
import sys
import time
import numpy as np
from skimage import data
height, width, frames = (int(word) for word in sys.argv[1:])
picture = np.hstack([data.camera().astype(float)] * 2)[:height, :width]
photons = np.stack([np.roll(picture, 2 * t, axis=1) for t in range(frames)]) * (3.25 / picture.mean())
from qsim.keys import Key
from qsim.process import peak_memory
from qsim.sensor.devices import quiver_physical
sensor = quiver_physical(3.25)
codes = sensor.sample(photons, 5e-4, key=Key(0, 0))
"""
LOOP = """
for _ in sys.stdin:
    started = time.perf_counter()
    once()
    print(time.perf_counter() - started, peak_memory(), flush=True)
"""
QBP = """
from quiver.baselines import METHODS
def once():
    METHODS["qbp-bm3d"].restore(codes, sensor, 5e-4)
"""
MERGENET = """
from quiver.data.codes import array_codes
from quiver.restoration.restorers import restorer
known = array_codes(codes, sensor, 5e-4)
method = restorer("mergenet")
def once():
    method.restore(known)
"""


class Program:
    """One program that runs once for every line on its input."""

    def __init__(self, text: str, size: tuple[int, int], frames: int) -> None:
        words = [sys.executable, "-W", "ignore", "-c", LIGHT + text + LOOP, *map(str, (*size, frames))]
        self.process = subprocess.Popen(words, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def run(self) -> tuple[float, float]:
        """Return the seconds of one run, and the most memory so far [bytes]."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline().split()
        if len(line) != 2:
            raise ValueError(f"a program ended with exit code {self.process.wait()}; its message stands above")
        return float(line[0]), float(line[1])

    def close(self) -> None:
        """End the program."""
        self.process.communicate()


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=2, help="counted runs of each program (default 2)")
    parser.add_argument("--size", default="512x1024", help="HEIGHTxWIDTH, up to 512x1024 (default)")
    parser.add_argument("--busy", action="store_true", help="measure beside other programs; the page says so")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results" / "restorer_cost.md", help="page")
    args = parser.parse_args(words)
    try:
        size = sides(args.size)
        if args.runs < 1:
            raise ValueError(f"--runs {args.runs}: give at least 1")
        if not args.busy:
            rows.wait_for_quiet()
        found = measured(size, args.runs)
        memory = command_memory(size)
    except ValueError as error:
        print(f"restorer_cost: {error}", file=sys.stderr)
        return 2
    text = page(found, memory, args.size, args.busy)
    write_bytes(args.out, text.encode())
    print(text)
    return 0


def sides(text: str) -> tuple[int, int]:
    """Return height and width of HEIGHTxWIDTH; `ValueError` for anything else, and beyond the photograph."""
    match = re.fullmatch(r"(\d{1,4})x(\d{1,4})", text)
    found = [int(part) for part in match.groups()] if match else []
    if not found or not 16 <= found[0] <= 512 or not 16 <= found[1] <= 1024:
        raise ValueError(f"--size {text}: give HEIGHTxWIDTH from 16x16 to 512x1024")
    return found[0], found[1]


def measured(size: tuple[int, int], runs: int) -> dict[str, list[tuple[float, float]]]:
    """Return seconds per frame and memory of the counted runs of both programs."""
    programs = {"QBP + BM3D": Program(QBP, size, FRAMES), "mergenet": Program(MERGENET, size, FRAMES)}
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in programs}
    for turn in range(runs + 1):
        for name, program in programs.items():
            seconds, memory = program.run()
            if turn:
                found[name].append((seconds / FRAMES, memory))
    for program in programs.values():
        program.close()
    return found


def command_memory(size: tuple[int, int]) -> int:
    """Return the most memory [bytes] of a process of `quiver restore` with its defaults, on such frames."""
    picture = np.hstack([data.camera().astype(float)] * 2)[: size[0], : size[1]]
    photons = np.stack([np.roll(picture, 2 * t, axis=1) for t in range(FRAMES)]) * (3.25 / picture.mean())
    sensor = quiver_physical(3.25)
    with tempfile.TemporaryDirectory() as folder:
        codes = Path(folder) / "codes.npy"
        out = Path(folder) / "restored.npy"
        np.save(codes, sensor.sample(photons, 5e-4, key=Key(0, 0)))
        words = ["restore", codes, "--ppp", "3.25", "--method", "mergenet", "-q", "-o", out]
        program = [sys.executable, "-c", COMMAND, *map(str, words)]
        done = subprocess.run(program, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        raise ValueError(f"quiver restore ended with exit code {done.returncode}; its message stands above")
    return int(done.stdout.splitlines()[-1])


def page(found: dict[str, list[tuple[float, float]]], memory: int, size: str, busy: bool) -> str:
    """Return the page of both programs, and of the memory of the command."""
    classical, network = (median(seconds for seconds, _ in runs) for runs in found.values())
    table = [
        (
            name,
            f"{median(s for s, _ in runs):.2f}",
            " ".join(f"{s:.2f}" for s, _ in runs),
            f"{runs[-1][1] / 1e6:.0f} MB",
        )
        for name, runs in found.items()
    ]
    text = result_page.head("What the restorer costs", "restorer_cost.py")
    text += [f"Seconds per frame of {size}, eleven frames at 3 bits and 3.25 PPP, both programs in turn.", ""]
    text += [*markdown_table(table, ("program", "median [s]", "runs [s]", "most memory of the process")), ""]
    text += [
        f"`quiver restore` of these frames takes {memory / 1e6:.0f} MB, its complete process counted. The "
        "programs of the table also hold and draw the light.",
        "",
    ]
    text += [f"Ratio of the medians: {classical / network:.2f}. Machine: {rows.machine()}.", ""]
    return "\n".join([*text, *(["Measured beside other programs.", ""] if busy else [])])


if __name__ == "__main__":
    sys.exit(main())
