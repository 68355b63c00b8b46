"""Trains a network in parts that may lie days apart, and keeps its newest weights, their curve and the hours.

    python benchmarks/long_run.py out/starter --steps 1000          # one more part, from the last weights
    python benchmarks/long_run.py out/starter --score               # the newest weights beside classical methods
    python benchmarks/long_run.py out/starter                       # the page alone

A part begins with the weights that the last one ended with, stored as float16, with an optimiser and a cosine of its
own. A part that is interrupted resumes by the same command while its run lies in the folder of work. The settings are
those that learned fastest (docs/results/recipe_rows.md), at lights of 2 to 26 photons.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

from rows import LIGHTS, ROOT, Budget, interval, keep_apart, machine, recipe_digest, scores, settings_of

from qsim.figures import new_figure, write_figure
from qsim.files import VERSION, read_json, write_bytes, write_json
from qsim.tables import markdown_table
from quiver.model.weights import halved

NETWORK = "quiver-s-1m"
SETTINGS = ("--frames", "21", "--crop", "96", "--ppp", "2,3.25,5,9.75,16,26")
SMALL = ("--frames", "12", "--crop", "32")  # with --tiny
VALIDATIONS = 4  # of a part
BESIDE = ("moment", "qbp-bm3d")


def main(words: list[str] | None = None) -> int:
    args = parser().parse_args(words)
    try:
        args.work = keep_apart("long_run", args.out, args.work, trial=args.tiny)
        args.out.mkdir(parents=True, exist_ok=True)
        if args.steps is not None:
            add_part(args)
        if args.score:
            score(args)
    except (ValueError, OSError) as error:
        print(f"long_run: {error}", file=sys.stderr)
        return 2
    except subprocess.CalledProcessError as stopped:
        print(f"long_run: a command failed with {stopped.returncode}; the same command resumes", file=sys.stderr)
        return stopped.returncode
    write_page(args.out)
    return 0


def parser() -> argparse.ArgumentParser:
    """Return the options of this program."""
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("data", type=Path, nargs="+", help="data sets; the first one has splits val and test, too")
    made.add_argument("--steps", type=int, help="train one more part of so many steps")
    made.add_argument("--learning-rate", type=float, default=3e-3, help="highest rate of the part (default 3e-3)")
    made.add_argument(
        "--processes", type=int, default=2, help="of one thread, each with a window of a step (default 2)"
    )
    made.add_argument(
        "--score", action="store_true", help="score the newest weights on the test clips of the data sets"
    )
    made.add_argument("--out", type=Path, default=ROOT / "docs" / "results" / "long_run", help="folder of the parts")
    made.add_argument("--work", type=Path, help="folder of runs, which can be deleted (default out/long_run)")
    made.add_argument("--tiny", action="store_true", help="crops of 32 px: a test of this program")
    return made


def parts_of(out: Path) -> list[dict[str, Any]]:
    """Return the stored parts in order."""
    return [read_json(path) for path in sorted(out.glob("part-*.json"))]


def weights_of(out: Path) -> Path:
    """Return the file of the newest weights."""
    return out / f"{NETWORK}.safetensors"


def add_part(args: argparse.Namespace) -> None:
    """Train a part and store its weights, curve and settings."""
    number = len(parts_of(args.out)) + 1
    folder = args.work / f"part-{number:02d}"
    start = ("--start", weights_of(args.out)) if number > 1 else ()
    settings = SMALL if args.tiny else SETTINGS
    words: list[object] = ["train", *args.data, "-o", folder, "--preset", NETWORK, "--device", "cpu", "--threads", 1]
    words += ["--seed", number, "--steps", args.steps, "--validate-every", max(1, args.steps // VALIDATIONS)]
    words += ["--batch", 1, "--learning-rate", args.learning_rate, *settings, *start, "-q"]
    several = ("-m", "torch.distributed.run", "--nproc-per-node", args.processes) if args.processes > 1 else ()
    module = ("-m", "--", "quiver") if several else ("-m", "quiver")  # torchrun would read --start as its own
    line = [str(word) for word in (*several, *module, *words)]
    print(f"\n$ python {shlex.join(line)}", flush=True)
    subprocess.run([sys.executable, *line], check=True)
    history = read_json(folder / "history.json")["history"]
    row = {"quiver": VERSION, "machine": machine(), "processes": args.processes, "settings": settings_of(folder)}
    row |= {"data": [path.name for path in args.data], "recipes": [recipe_digest(path) for path in args.data]}
    write_bytes(weights_of(args.out), halved(folder / "last.safetensors"))
    write_json(args.out / f"part-{number:02d}.json", row | {"history": history})


def score(args: argparse.Namespace) -> None:
    """Score the newest weights and classical methods on the test clips of each data set."""
    methods = [str(weights_of(args.out)), *BESIDE]
    found = {}
    for data in args.data:
        found[data.name] = scores(methods, args.work / f"scores-{data.name}", data, LIGHTS, Budget(threads=2))
    write_json(args.out / "scores.json", {"parts": len(parts_of(args.out)), "sets": found})


def write_page(out: Path) -> None:
    """Write the page and the curve."""
    parts = parts_of(out)
    if not parts:
        return
    lines = []
    points: list[tuple[float, float]] = []
    hours = 0.0
    windows = 0
    for number, part in enumerate(parts, 1):
        last = part["history"][-1]
        each = part["settings"]["batch"] * part["processes"]
        points += [(windows + each * entry["step"], entry["psnr_matched"]) for entry in part["history"]]
        windows += each * last["step"]
        hours += last["elapsed"] / 3600
        rate = f"{part['settings']['learning_rate']:g}"
        told = (number, part["processes"], last["step"], rate, f"{hours:.1f}", windows, f"{last['psnr_matched']:.2f}")
        lines.append([str(value) for value in told])
    header = ("part", "cores", "steps", "rate", "hours so far", "windows so far", "validation [dB]")
    figure = new_figure(6, 3.5)
    axes = figure.subplots()
    axes.semilogx(*zip(*points, strict=True), "o-")
    axes.set_xlabel("windows seen")
    axes.set_ylabel("validation PSNR [dB]")
    write_figure(figure, out.with_suffix(".png"))
    text = f"""# A small QUIVER, trained in parts

Made by `python benchmarks/long_run.py {" ".join(f"out/{name}" for name in parts[-1]["data"])}`.

`{NETWORK}` learns from rendered scenes at 2 to 26 photons and 3 bits. The validation is the mean over all these
lights. Hours are those of the clock, on as many cores as the table tells.

{chr(10).join(markdown_table(lines, header))}

![Validation PSNR over windows seen]({out.name}.png)
{scores_table(out)}
Machine: {"; ".join(sorted({part["machine"] for part in parts}))}.
"""
    write_bytes(out.with_suffix(".md"), text.encode())


def scores_table(out: Path) -> str:
    """Return the section of scores, empty where there are none."""
    path = out / "scores.json"
    if not path.exists():
        return ""
    found = read_json(path)
    lines = [
        [name, Path(method).stem, *(interval(lights[light]["scores"]["psnr_matched"], 2) for light in lights)]
        for name, methods in found["sets"].items()
        for method, lights in methods.items()
    ]
    header = ("set", "method", *(f"{light} PPP" for light in LIGHTS))
    table = "\n".join(markdown_table(lines, header))
    return f"\n## Test clips, after part {found['parts']}, matched PSNR [dB]\n\n{table}\n"


if __name__ == "__main__":
    sys.exit(main())
