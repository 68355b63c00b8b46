"""Measures what a data set of many clips costs beside its clips: seconds, memory, files and bytes of each command.

    python benchmarks/million_clips.py --sizes 1000,10000,100000,1000000 --out docs/results/million_clips.json

A writer of tiny clips (3 frames of 8 x 8 pixels, one stream) stands in for the renderer. It writes a part of a thousand
clips. The others have records and descriptions of their own, and their frames and codes are links to the files of the
first. Of sets of more than `--described` clips only the first thousand are made so, the others are links to the folder
of the first: every clip then has two entries, and commands read a full folder. Each command runs in a new process;
memory is the peak of that process.

    one shard   one clip as task 1 of N:  qsim generate RECIPE --shard 1/N
    plan shard  the kinds of that shard, without rendering
    open        quiver.windows of the finished set
    window      one training window, mean over 200 at random places
    check       one part of a thousand clips:  qsim check SET --shard 1/N
    resume      one part of a thousand clips, all finished
    publish     the first thousand clips as WebDataset:  qsim publish SET -o OUT --shard 1/N
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import result_page

from qsim import descriptions, keys, records
from qsim.clip.clip_info import PHYSICAL
from qsim.clip.writer import ClipWriter
from qsim.dataset import recipe
from qsim.dataset.cost_forecast import kinds_of
from qsim.dataset.dataset import Dataset
from qsim.dataset.generation import Options, generate, shard, write_manifest
from qsim.dataset.job import Job
from qsim.dataset.job_record import JobRecord, record_path
from qsim.dataset.job_runner import make_block
from qsim.dataset.provenance import origin
from qsim.files import VERSION, write_json
from qsim.optics.camera import Camera
from qsim.streams.clip import Clip
from qsim.tables import markdown_table

RECIPE = """[recipe]
name = "tiny"
frames = 3
height = 8
width = 8
[[scenes]]
family = "fan"
seeds = "0..{last}"
[[scenes]]
family = "tumble"
seeds = "0..9"
split = "test"
[[streams]]
sensor = "quiver-physical"
bits = 3
ppp = 3.25
"""
ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "million.md"
ROWS = ROOT / "docs" / "results" / "million_clips.json"
CLIPS = 10**6
PRICES = {"core hour": 0.04, "GPU hour": 2.5, "TB and month": 20.0}  # USD, assumed
COUNTS = {
    "files": "files",
    "entries of the fullest folder": "fullest_folder",
    "size of dataset.json [bytes]": "dataset_json",
}
HEAD = (
    "\n".join(result_page.head("A million clips", "million_clips.py --page"))
    + """
A recipe with `seeds = "0..999999"` begins as fast as one with a single seed. Clips are counted from the recipe, files
lie in blocks of a thousand clips ([data sets](datasets.md)), and training opens a clip when it draws from it. This page
says what the bookkeeping costs, and what the clips cost.

## The bookkeeping

Tiny clips of 3 frames of 8 x 8 px stand in for rendered ones. `one shard` and `plan shard` are of one clip, `check`,
`resume` and `publish` of a part of a thousand. Each ran in a process of its own, without the time of imports, on two
cores that other programs shared.
"""
)
TESTED = 10  # clips, the last ones of the recipe
PART = 1000  # clips of one part of `check`, `resume` and `publish`


def wanted(clips: int) -> recipe.Recipe:
    """Return the recipe of so many clips, ten of them to test."""
    return recipe.parse(RECIPE.format(last=clips - TESTED - 1))


def make(job: Job, path: Path) -> Clip:
    """Write a job's tiny clip."""
    settings = job.settings
    camera = Camera(8e-3, 2.8, 1e-5, settings.height, settings.width, origin=(0, 0, 3))
    meta = {
        "shape": [settings.frames, settings.height, settings.width],
        "frame_rate": settings.frame_rate,
        "shutter": settings.shutter,
        "exposure": 1 / settings.frame_rate,
        "radiance_unit": PHYSICAL,
        "camera": records.plain(camera),
    }
    rng = np.random.default_rng(job.scene_seed)
    with ClipWriter(path, meta | records.plain(origin(job))) as writer:
        for t in range(settings.frames):
            if not writer.has(t):
                writer.add(t, 0.5 + rng.random((settings.height, settings.width)), error=1e-3)
    return Clip.open(path)


def link_rest(folder: Path, clips: int, *, described_each: bool) -> None:
    """Make the other clips by links to the first: own descriptions and record, shared frames and codes.

    Without `described_each` only those of the first part and those to test are, and the others are links to the folder,
    with records.
    """
    found = wanted(clips)
    write_manifest(found, folder)
    first = found.jobs[0]
    source = folder / "clips" / first.key
    made = [path.relative_to(source) for path in source.rglob("*") if path.is_file()]
    shared = [path for path in made if path.suffix != ".json"]
    described = {path: _unsealed(source / path) for path in made if path.suffix == ".json"}
    block = ""
    for number, job in enumerate(found.jobs):
        if record_path(folder, job.key).exists():
            continue
        if job.block != block:
            block = job.block
            make_block(folder, job)
        target = folder / "clips" / job.key
        record_path(folder, job.key).write_text(json.dumps(descriptions.values_of(JobRecord.of(job))))
        if not described_each and PART <= number < clips - TESTED:
            target.symlink_to(source)
            continue
        target.mkdir()
        for path in shared:
            (target / path).parent.mkdir(exist_ok=True)
            os.link(source / path, target / path)
        for path, about in described.items():
            of_stream = {"clip": job.name, "clip_key": keys.hash_name(job.name)}
            own = about | (of_stream if "clip" in about else records.plain(origin(job)) | {"name": job.name})
            (target / path).write_text(json.dumps(descriptions.sealed(own)))


def _unsealed(path: Path) -> dict[str, Any]:
    """Return the contents of a description without its checksum."""
    found = json.loads(path.read_bytes())
    del found["checksum"]
    return dict(found)


# ---- One command, in a process of its own


def one_shard(folder: Path, clips: int) -> None:
    summary = generate(wanted(clips), folder, Options(workers=0, shard=(1, clips)), make=make)
    assert summary.done == 1, summary


def plan_shard(folder: Path, clips: int) -> None:
    assert sum(map(len, kinds_of(recipe.Recipe("tiny", shard(wanted(clips).jobs, (1, clips)))))) == 1


def resume(folder: Path, clips: int) -> None:
    summary = generate(wanted(clips), folder, Options(workers=0, shard=(1, max(1, clips // PART))), make=make)
    assert (summary.made, summary.done) == (0, summary.jobs), summary


def check(folder: Path, clips: int) -> None:
    assert Dataset.open(folder).verify(shard=(1, max(1, clips // PART))) == []


def publish(folder: Path, clips: int) -> None:
    from qsim.publishing import Publication
    from qsim.publishing import publish as publish_part

    publish_part(folder, folder.parent / "published", Publication(to="webdataset"), part=(1, max(1, clips // PART)))


def open_windows(folder: Path, clips: int) -> None:
    import quiver

    assert len(quiver.windows(folder, split="train", frames=3, crop=8)) == clips - TESTED


def window(folder: Path, clips: int) -> dict[str, float]:
    import quiver

    data = quiver.windows(folder, split="train", frames=3, crop=8)
    _ = data[0]
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    started = time.perf_counter()
    for number in range(1, 201):
        _ = data[number * 7919 % len(data)]
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {"each": (time.perf_counter() - started) / 200, "growth_MB": (after - before) * 1024 / 1e6}


COMMANDS = {
    "one shard": one_shard,
    "plan shard": plan_shard,
    "open": open_windows,
    "window": window,
    "check": check,
    "resume": resume,
    "publish": publish,
}


def measured(command: str, folder: Path, clips: int) -> dict[str, float]:
    """Run one command in a new process; return its seconds without imports, and the peak of its memory."""
    words = [sys.executable, __file__, "--command", command, "--folder", str(folder), "--sizes", str(clips)]
    return dict(json.loads(subprocess.run(words, check=True, capture_output=True, text=True).stdout))


def run_command(command: str, folder: Path, clips: int) -> dict[str, float]:
    if command in ("open", "window"):
        import quiver

        _ = quiver.windows
    if command == "one shard":  # the first clip of a process also imports
        generate(wanted(1000), folder.parent / "first", Options(workers=0, shard=(1, 1000)), make=make)
    started = time.perf_counter()
    found = COMMANDS[command](folder, clips) or {}
    seconds = time.perf_counter() - started
    return {"seconds": seconds, "MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6, **found}


# ---- The folder


def contents(folder: Path) -> dict[str, int]:
    """Return the number of files, their bytes, and the entries of the fullest folder."""
    files = size = fullest = 0
    for place, folders, names in os.walk(folder):
        fullest = max(fullest, len(folders) + len(names))
        files += len(names)
        size += sum(os.lstat(Path(place) / name).st_size for name in names)
    return {"files": files, "bytes": size, "fullest_folder": fullest, "dataset_json": _size(folder / "dataset.json")}


def _size(path: Path) -> int:
    return path.stat().st_size


def two_at_once(folder: Path, clips: int) -> dict[str, Any]:
    """Make ten clips each as two tasks at once, one of which is killed and started again; `check` finds no damage."""
    parts = max(1, clips // 10)
    words = [sys.executable, __file__, "--folder", str(folder), "--sizes", str(clips), "--part"]
    started = time.perf_counter()
    tasks = [subprocess.Popen([*words, f"{i}/{parts}"]) for i in (1, 2)]
    done = folder / "jobs"
    while len(list(done.rglob("*.json"))) < 3:
        time.sleep(0.01)
    os.kill(tasks[0].pid, signal.SIGKILL)
    tasks[0].wait()
    again = subprocess.run([*words, f"1/{parts}"], check=False).returncode
    codes = [again, tasks[1].wait()]
    data = Dataset.open(folder)
    problems = [line for i in (1, 2) for line in data.verify(shard=(i, parts))]
    return {"seconds": time.perf_counter() - started, "exit_codes": codes, "problems": problems}


def measure(clips: int, described: int, place: Path) -> dict[str, Any]:
    """Return the row of one size."""
    begun = place / "begun"
    row: dict[str, Any] = {"clips": clips, "one shard": measured("one shard", begun, clips)}
    row["plan shard"] = measured("plan shard", begun, clips)
    row["two at once, one killed"] = two_at_once(place / "two", clips)
    folder = place / "whole"
    started = time.perf_counter()
    generate(wanted(clips), folder, Options(workers=0, shard=(1, max(1, clips // PART))), make=make)
    row["writing one clip"] = {"seconds": (time.perf_counter() - started) / PART}
    link_rest(folder, clips, described_each=clips <= described)
    for command in ("open", "window", "resume", "check", "publish"):
        row[command] = measured(command, folder, clips)
    return row | contents(folder)


# ---- The page


def page(found: dict[str, Any]) -> str:
    """Return the page of the measured rows, and of what a million clips of the recipe i2_2000fps cost."""
    rows = found["rows"]
    header = ["what", *(f"{row['clips']:,} clips" for row in rows), "slope"]
    lines = [_seconds(name, rows) for name in COMMANDS if name != "window"]
    lines += [
        ["a window [ms]", *(f"{1e3 * row['window']['each']:.0f}" for row in rows), ""],
        ["growth of memory over 200 windows [MB]", *(f"{row['window']['growth_MB']:.1f}" for row in rows), ""],
        ["most memory of a command [MB]", *(f"{_memory(row):.0f}" for row in rows), ""],
        *([what, *(f"{row[key]:,}" for row in rows), ""] for what, key in COUNTS.items()),
    ]
    damaged = any(row["two at once, one killed"]["problems"] for row in rows)
    verdict = "were damaged" if damaged else "were whole"
    more = [
        "",
        "The slope is that of seconds over clips, on logarithmic scales: 0 is constant, 1 is linear. At each size two",
        f"tasks ran at once, and one of them was killed and started again: their files {verdict}. Of sets above 10,000",
        "clips, those beyond the first thousand are links to one clip, with records of their own.",
        "",
    ]
    return "\n".join([HEAD, *markdown_table(lines, header), *more, *costs()]) + "\n"


def _seconds(name: str, rows: list[dict[str, Any]]) -> list[str]:
    """Return the cells of a command: seconds at each size, and their slope."""
    known = {row["clips"]: row[name]["seconds"] for row in rows if name in row}
    sizes = np.log10(np.array(list(known)))
    slope = np.polyfit(sizes, np.log10(np.array(list(known.values()))), 1)[0]
    cells = [f"{known[row['clips']]:.2f}" if row["clips"] in known else "" for row in rows]
    return [f"{name} [s]", *cells, f"{slope:.2f}"]


def _memory(row: dict[str, Any]) -> float:
    return float(max(row[name]["MB"] for name in COMMANDS if name in row))


def costs() -> list[str]:
    """Return the lines on what the clips themselves cost, from the rates of the pages of results."""
    results = ROOT / "docs" / "results"
    plan = json.loads((results / "i2.json").read_text())
    made = plan["plans"]["reuse"]
    hours = made["processor_hours"] / plan["clips"]
    gigabytes = made["gigabytes"] / plan["clips"]
    gpu = re.search(r"\| fence \| cuda \| 512 x 1024 \|([^\n]*)", (results / "gpu.md").read_text())
    assert gpu is not None
    _, frame, first, choosing = (float(cell) for cell in gpu[1].split("|")[:4])
    fence = choosing + first + 64 * frame
    dearer = hours / next(kind for kind in made["kinds"] if kind["family"] == "fence")["processor_hours"]
    gpu_hours = fence * dearer / 3600
    rows = [
        _cost("processor", hours * CLIPS, "core hours", hours * CLIPS / 16, "core hour"),
        _cost("GPU", gpu_hours * CLIPS, "GPU hours", gpu_hours * CLIPS, "GPU hour"),
        _cost("disk", gigabytes * CLIPS / 1e3, "TB", None, "TB and month"),
    ]
    return [
        "## The clips",
        "",
        "A million clips of 65 frames of 512 x 1024 px at 40 dB, made as the 280 of `scenes/i2_2000fps.toml`:",
        "",
        *markdown_table(rows, ["on", "work", "on 100 machines", "money"]),
        "",
        f"- **Processor.** A clip takes {hours:.3f} core hours in [the plan of that recipe](results/i2.md). A machine",
        f"  here has 16 cores. A worker takes {made['memory']:.1f} GB.",
        f"- **GPU.** A clip of `fence` takes {fence:.1f} s by [the measured frame](results/gpu.md) of an H200. The",
        f"  mean clip costs {dearer:.2f} times as much on the processor; that it does so on a GPU is assumed.",
        f"- **Disk.** A clip takes {gigabytes:.3f} GB: radiance, truth and streams.",
        "- **Money.** The prices are assumed: "
        + ", ".join(f"{price:g} USD for a {unit}" for unit, price in PRICES.items())
        + ".",
        "",
        "Each task of a job array makes one part, and any task may be killed and started again:",
        "",
        "<!-- not run: needs SLURM and thousands of hours -->",
        "```sh",
        "qsim plan million.toml --shard 1/10000",
        "sbatch --array=1-10000 --wrap 'qsim generate million.toml -o /shared/m --shard $SLURM_ARRAY_TASK_ID/10000'",
        "sbatch --array=1-10000 --wrap 'qsim check /shared/m --shard $SLURM_ARRAY_TASK_ID/10000'",
        "```",
    ]


def _cost(on: str, work: float, unit: str, machine_hours: float | None, priced: str) -> list[str]:
    """Return the cells of a resource: work, hours on a hundred machines, and money."""
    hours = "" if machine_hours is None else f"{machine_hours / 100:,.0f} hours"
    month = " a month" if "month" in priced else ""
    return [on, f"{work:,.0f} {unit}", hours, f"{work * PRICES[priced]:,.0f} USD{month}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", default="1000,10000,100000", help="numbers of clips")
    parser.add_argument("--described", type=int, default=10000, help="most clips of a set that all are described")
    parser.add_argument("--folder", type=Path, help="place for the sets; a temporary folder by default")
    parser.add_argument("--out", type=Path, help="file of the rows; those of other sizes stay")
    parser.add_argument("--command", choices=COMMANDS, help=argparse.SUPPRESS)
    parser.add_argument("--part", help=argparse.SUPPRESS)
    parser.add_argument("--page", action="store_true", help=f"write {PAGE.name} from {ROWS.name}")
    args = parser.parse_args()
    if args.page:
        PAGE.write_text(page(json.loads(ROWS.read_text())))
        return
    sizes = [int(size) for size in args.sizes.split(",")]
    if args.command:
        print(json.dumps(run_command(args.command, args.folder, sizes[0])), flush=True)
        os._exit(0)  # one in ten processes with torch crashes at its end on this machine, after its work
    if args.part:
        part, parts = map(int, args.part.split("/"))
        generate(wanted(sizes[0]), args.folder, Options(workers=0, shard=(part, parts)), make=make)
        return
    earlier = json.loads(args.out.read_text())["rows"] if args.out and args.out.exists() else []
    rows = {row["clips"]: row for row in earlier}
    for clips in sizes:
        with tempfile.TemporaryDirectory(dir=args.folder, prefix="million-") as place:
            rows[clips] = measure(clips, args.described, Path(place))
            print(json.dumps(rows[clips]), flush=True)
        if args.out:
            write_json(args.out, {"qsim": VERSION, "part": PART, "rows": [rows[size] for size in sorted(rows)]})


if __name__ == "__main__":
    main()
