"""Runs `qsim demo`: the commands from scenes to restored video, and one page of the results.

Every step is one printed command of `qsim` or `quiver`; a finished step is not repeated. Two real measurements
are in the package (qsim/measurements/, with their licences).
"""

from __future__ import annotations

import io
import shlex
import subprocess
import sys
import time
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import numpy as np

from qsim import opening
from qsim.cli.command import command
from qsim.cli.console import OPTIONAL, RESUMES, failed, output, running
from qsim.cli.options import check_free
from qsim.dataset.dataset import Dataset
from qsim.files import to_json, write_bytes, write_json
from qsim.settings import setting
from qsim.terminal import is_lost, printable

MEASUREMENTS = Path(__file__).parents[1] / "measurements"
MARK = "demo.json"  # marks a folder as one that this command fills
MINUTES = "2"  # of training
RATE = "3e-4"  # a tenth of the protocol's: the weights are trained already
LIGHT = ("--ppp", "3.25", "--bits", "3")
NETWORK = "mergenet"  # also the name of the weights that ship with the package
METHODS = ("naive:1", "naive:11", "moment:3", "qbp-bm3d", NETWORK)


@dataclass(frozen=True)
class Demo:
    """Where `qsim demo` writes."""

    folder: Annotated[Path, setting("to fill", positional=True)] = Path("out/demo")


@command("qsim demo", "qsim demo out/demo", after_interrupt=RESUMES)
def demo(asked: Demo) -> int:
    """Run all steps; the same command resumes after a failure or Ctrl-C."""
    from qsim.process import peak_memory_of_children

    check_free(asked.folder)
    for package in OPTIONAL["networks"][0]:
        if not find_spec(package):
            raise ModuleNotFoundError(f"No module named {package!r}", name=package)
    started = time.perf_counter()
    out = asked.folder
    claim(out)
    try:
        steps(out, running().silent)
    except subprocess.CalledProcessError as error:
        step = shlex.join(error.cmd[2:])
        again = shlex.join(["qsim", "demo", str(out)])
        return failed(
            f"qsim demo: stopped at '{step}'; `{again}` resumes there", error.returncode, running().printing.json
        )
    minutes = (time.perf_counter() - started) / 60
    peak = peak_memory_of_children()
    page = out / "index.html"
    facts = {"page": str(page), "minutes": minutes, "largest_process_bytes": peak}
    output(facts, f"\ndemo: {minutes:.1f} minutes, largest process {peak / 2**30:.2f} GB; open {page}")
    return 0


def claim(out: Path) -> None:
    """Make the folder and mark it; `FileExistsError` if it holds files but not the mark: somebody else's."""
    mark = out / MARK
    ours = {"format": "qsim-demo-1"}
    if mark.is_file() and not mark.is_symlink() and opening.content(mark) == to_json(ours):
        return
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise FileExistsError(f"{out}: exists and was not made by `qsim demo`; name another folder")
    out.mkdir(parents=True, exist_ok=True)
    write_json(mark, ours)


def call(words: list[str], capture: bool) -> str:
    """Run a command and return what it printed if `capture`; `CalledProcessError` if it fails.

    Ctrl-C reaches the command, too, which then saves its state: wait for it.
    """
    target = subprocess.PIPE if capture else None
    if not capture and is_lost(sys.stdout):
        target = subprocess.DEVNULL
    child = subprocess.Popen(words, text=True, stdout=target)
    try:
        printed, _ = child.communicate()
    except KeyboardInterrupt:
        child.wait()
        raise
    if child.returncode:
        raise subprocess.CalledProcessError(child.returncode, words)
    return printed or ""


def steps(out: Path, quiet: bool) -> None:
    """Render and sense, train, restore, score, draw: each step is a command. `CalledProcessError` if one fails."""

    def run(what: str, program: str, *arguments: str | Path, capture: bool = False) -> str:
        """Run one command; its progress goes to the terminal."""
        words = [str(word) for word in (*arguments, *(["--quiet"] if quiet else []))]
        if not quiet:
            print(printable(f"\n{what}\n  $ {program} {shlex.join(words)}"), flush=True)
        return call([sys.executable, "-m", program, *words], capture or quiet)

    def restore(source: Path, target: Path, method: str) -> None:
        if not target.with_suffix(".json").exists():
            run(f"Restoring {source.name}", "quiver", "restore", source, "-o", target, "--method", method)

    data = out / "data"
    trained = out / "trained"
    title = "From a scene to restored video"
    run("Rendering moving scenes at 2000 fps and sensing them", "qsim", "generate", "demo", "-o", data)
    how = ("--preset", NETWORK, "--start", NETWORK, "--learning-rate", RATE, "--minutes", MINUTES, *LIGHT)
    run(f"Training the shipped {NETWORK} further on these scenes", "quiver", "train", data, "-o", trained, *how)
    for name in Dataset.open(data).names("test"):
        restore(data / "clips" / name, out / f"{name}_trained_here.npy", str(trained))
        restore(data / "clips" / name, out / f"{name}_shipped.npy", NETWORK)
    ball = out / "ball"
    if not ball.exists():
        content = io.BytesIO()
        np.save(content, np.load(MEASUREMENTS / "ball_12bit.npz")["frames"])
        write_bytes(out / "ball_12bit.npy", content.getvalue())
        camera = ("--frame-rate", "30000", "--exposure", "20e-6", "--transfer", "linear", "--white", "4095")
        run("Real video at 30 000 fps becomes a clip", "qsim", "convert", out / "ball_12bit.npy", ball, *camera)
    run("... and is sensed", "qsim", "sense", ball, *LIGHT)
    restore(ball, out / "real_ball.npy", str(trained))
    methods = ",".join([*METHODS, str(trained)])
    run("Scores on held-out scenes", "quiver", "evaluate", data, "-o", out / "scores", "--methods", methods, *LIGHT)
    real = out / "real_photons.json"
    if not real.exists():
        static = ("evaluate", "--static", MEASUREMENTS / "hazelnut_gates6.npz", "--methods", methods, "--json")
        write_bytes(real, run("Scores on real photons", "quiver", *static, capture=True).encode())
    run("The page", "qsim", "report", out, "-o", out / "index.html", "--force", "--title", title)
