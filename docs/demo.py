"""Runs the demo: the commands from scenes to restored video, and one page of the results.

    python docs/demo.py out/demo

Every step is one printed command of `qsim` or `quiver`; a finished step is not repeated. The last line states the time
and the memory of the run.
"""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from qsim.process import peak_memory_of_children

ROOT = Path(__file__).parents[1]
DATA = ROOT / "tests" / "data"
PPP, BITS = "3.25", "3"
MINUTES = "2"  # of training
METHODS = ("naive:1", "naive:11", "moment:3", "nano")  # nano = the weights that ship with the package


def main(out: Path) -> int:
    started = time.perf_counter()
    out.mkdir(parents=True, exist_ok=True)
    try:
        steps(out)
    except subprocess.CalledProcessError as failed:
        print(f"demo: stopped at '{shlex.join(failed.cmd[2:])}'; `make demo` resumes there", file=sys.stderr)
        return failed.returncode
    minutes = (time.perf_counter() - started) / 60
    peak = peak_memory_of_children() / 2**30
    print(f"\ndemo: {minutes:.1f} minutes, largest process {peak:.2f} GB; open {out / 'index.html'}")
    return 0


def steps(out: Path) -> None:
    """Render and sense, train, restore, score, draw."""
    data, trained, light = out / "data", out / "trained", ["--ppp", PPP, "--bits", BITS]
    run(
        "Rendering moving scenes at 2000 fps and sensing them",
        "qsim",
        "generate",
        ROOT / "scenes" / "demo.toml",
        "-o",
        data,
    )
    run(
        "Training the small network",
        "quiver",
        "train",
        data,
        "-o",
        trained,
        "--preset",
        "nano",
        "--minutes",
        MINUTES,
        *light,
    )
    jobs = json.loads((data / "dataset.json").read_text())["jobs"]
    for name in [name for name, job in jobs.items() if job["split"] == "test"]:
        restore(data / "clips" / name, out / f"{name}_trained_here.npy", str(trained))
        restore(data / "clips" / name, out / f"{name}_shipped.npy", "nano")
    ball = out / "ball"
    if not ball.exists():
        frames = np.load(DATA / "ball_12bit.npz")["frames"]
        np.save(out / "ball_12bit.npy", frames)
        camera = ["--frame-rate", "30000", "--exposure", "20e-6", "--transfer", "linear", "--white", "4095"]
        run("Real video at 30 000 fps becomes a clip", "qsim", "convert", out / "ball_12bit.npy", ball, *camera)
    run("... and goes through the sensor", "qsim", "sense", ball, *light)
    restore(ball, out / "real_ball.npy", str(trained))
    methods = ",".join([*METHODS, str(trained)])
    run("Scores on held-out scenes", "quiver", "evaluate", data, "-o", out / "scores", "--methods", methods, *light)
    real = out / "real_photons.json"
    if not real.exists():
        counts = DATA / "hazelnut_gates6.npz"
        command = ["quiver", "evaluate", "--static", counts, "--methods", methods, "--json"]
        real.write_text(run("Scores on real photons", *command, capture=True))
    run(
        "The page",
        "qsim",
        "report",
        out,
        "-o",
        out / "index.html",
        "--force",
        "--title",
        "From a scene to restored video",
    )


def restore(source: Path, target: Path, method: str) -> None:
    if not target.with_suffix(".json").exists():
        run(f"Restoring {source.name}", "quiver", "restore", source, "-o", target, "--method", method)


def run(what: str, program: str, *arguments: str | Path, capture: bool = False) -> str:
    """Run one command; its progress goes to the terminal."""
    words = [str(word) for word in arguments]
    print(f"\n{what}\n  $ {program} {shlex.join(words)}", flush=True)
    done = subprocess.run(
        [sys.executable, "-m", program, *words], check=True, text=True, stdout=subprocess.PIPE if capture else None
    )
    return done.stdout or ""


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/demo")))
