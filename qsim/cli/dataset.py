"""Runs `qsim generate`, `plan` and `check` on data sets, and lists what they take: `qsim recipes`, `qsim sensors`."""

from __future__ import annotations

import argparse
import dataclasses
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from qsim import checks
from qsim.cli import documented_keys
from qsim.cli.console import PILOT, RESUMES, bar, command, note, output
from qsim.cli.options import checked, part_of
from qsim.dataset.job import Job
from qsim.dataset.recipe import Recipe
from qsim.rendering.render_settings import RenderSettings


def add_generate(sub: Any) -> None:
    """Add the command `generate` to a program."""
    parser = command(
        sub,
        "generate",
        _run_generate,
        "Make a data set from a recipe; finished jobs are kept.",
        "qsim generate starter -o out/starter --workers 2\nqsim generate mine.toml -o /data/mine --shard 7/100",
        RESUMES,
        threads="threads of the renderer (Dr.Jit) in each worker",
    )
    parser.add_argument("recipe", type=Path, help="a .toml file, or a name of `qsim recipes`")
    parser.add_argument("-o", "--output", type=Path, help="data set folder (default out/NAME of the recipe)")
    parser.add_argument("--workers", type=int, help="processes, each with its own renderer (default 1)")
    parser.add_argument("--shard", type=part_of, metavar="I/N", help="only the I-th of N parts, as in 7/100")
    memory = checked(checks.positive)
    parser.add_argument("--memory", type=memory, help="memory limit of a process, GiB (default 4)")
    parser.add_argument("--retry", action="store_true", help="try failed jobs again")
    parser.add_argument("--repair", action="store_true", help="check all files, and make damaged ones again")
    parser.add_argument("--wait", action="store_true", help="wait until no other generator uses the folder")
    parser.add_argument("--cluster", metavar="ADDRESS", help="address of a Dask scheduler, as in tcp://10.0.0.1:8786")
    parser.add_argument(
        "--gpus", type=float, default=0, help="GPU resource that each job takes on the cluster (default 0)"
    )


def _run_generate(args: argparse.Namespace) -> int:
    if args.threads is not None and args.cluster is not None:
        raise ValueError("--threads: acts on processes of this machine; start Dask workers with QSIM_THREADS=N instead")
    from qsim.dataset import generation, recipe
    from qsim.dataset.worker_pool import Limits

    wanted = recipe.load(args.recipe)
    folder = args.output = args.output or Path("out") / wanted.name
    # None: not given, as --cluster needs it (`_cluster`).
    count = generation.Options.workers if args.workers is None else args.workers
    limits = Limits() if args.memory is None else Limits(memory=args.memory)
    if count == 0 and args.memory is not None:
        raise ValueError("--memory: bounds worker processes, and --workers 0 has none; leave one of them out")
    if count < 0:
        raise ValueError(f"--workers: expected 0 (in this process) or more, got {count}")
    options = generation.Options(count, args.shard, args.retry, args.repair, args.wait, limits)
    chosen = generation.shard(wanted.jobs, args.shard)
    with bar(wanted.name, first=PILOT) as progress, generation.watching(folder, chosen, progress):
        summary = generation.generate(wanted, folder, options, run=_cluster(args))
    lines = [f"{folder}: {summary.done} of {summary.jobs} clips done, {summary.made} made now{_defaults(wanted)}"]
    lines += _empty(wanted, chosen)
    lines += [f"repaired {problem}" for problem in summary.repaired]
    lines += [f"FAILED {name}: {why}" for name, why in sorted(summary.failed.items())]
    lines += [f"SHARED {problem}" for problem in summary.shared]
    lines += _noisy(folder, chosen)
    if summary.failed:
        lines.append("run again with --retry after removing the cause")
    output(args, {"dataset": str(folder)} | dataclasses.asdict(summary), lines)
    return 0 if summary.done == summary.jobs and not summary.shared else 1


def _empty(wanted: Recipe, chosen: Sequence[Job]) -> list[str]:
    """Return a line for a shard without clips, which is no mistake of an array of jobs."""
    return [] if chosen else [f"this shard holds none of the {len(wanted.jobs)} clips of {wanted.name}"]


def _defaults(wanted: Recipe) -> str:
    """Return the defaults that a recipe does not set: `; by default frame_rate = 2000, shutter = 0`."""
    source = wanted.source
    assert source is not None
    taken = [
        f"{name} = {getattr(RenderSettings, name):g}"
        for name in ("frame_rate", "shutter", "psnr")
        if all(getattr(part, name) is None for part in (source.recipe, *source.scenes))
    ]
    taken += ["seed = 0"] if source.recipe.seed is None else []
    return f"; by default {', '.join(taken)}" if taken else ""


def _noisy(folder: Path, jobs: list[Job]) -> list[str]:
    """Return a line for each finished clip whose error exceeds that of the recipe."""
    from qsim.clip.clamped_error import stated
    from qsim.clip.manifest import read_info
    from qsim.rendering.fidelity import shortfall

    described = {job.name: folder / "clips" / job.name / "clip.json" for job in jobs}
    found = {name: stated(read_info(path)) for name, path in described.items() if path.is_file()}
    missed = {job.name: shortfall(found.get(job.name), job.settings.psnr) for job in jobs}
    return [f"{name} reached {why}" for name, why in missed.items() if why]


def _cluster(args: argparse.Namespace) -> Any:
    """Return the cluster of --cluster or None; `ValueError` for options of local processes beside it."""
    if not 0 <= args.gpus < float("inf"):
        raise ValueError(f"--gpus: expected 0 or more, got {args.gpus}")
    if args.cluster is None:
        if args.gpus:
            raise ValueError("--gpus: needs --cluster, whose workers state their GPUs; leave it out here")
        return None
    for option, given, instead in (("workers", args.workers, "nworkers"), ("memory", args.memory, "memory-limit")):
        if given is not None:
            raise ValueError(
                f"--{option}: changes nothing with --cluster: number, memory and lifetime of its workers are set where "
                f"they are started; leave it out and use `dask worker --{instead}` there"
            )
    if not re.fullmatch(r"(\w+://)?[^/\s]+:\d+", args.cluster):
        raise ValueError(f"--cluster {args.cluster}: is not the address of a scheduler, as tcp://10.0.0.1:8786 is")
    from qsim.dataset.dask_cluster import Cluster

    if not args.cluster.startswith("tls://"):
        note(f"{args.cluster}: without TLS, so anyone who can reach this port can run any program as its workers' user")
    return Cluster(args.cluster, gpus=args.gpus)


def add_plan(sub: Any) -> None:
    """Add the command `plan` to a program."""
    parser = command(
        sub,
        "plan",
        _run_plan,
        "Render one small job of each kind and print the forecast of a recipe's cost.",
        "qsim plan i2_2000fps --machines 10",
        threads="threads of the renderer (Dr.Jit)",
    )
    parser.add_argument("recipe", type=Path, help="a .toml file, or a name of `qsim recipes`")
    parser.add_argument("--machines", type=int, default=10, help="number of machines that share the work (default 10)")
    parser.add_argument("--frames", type=int, default=5, help="frames rendered per kind (default 5)")
    parser.add_argument("--shard", type=part_of, metavar="I/N", help="only the I-th of N parts, as in 7/100")


def _run_plan(args: argparse.Namespace) -> int:
    from qsim.dataset import cost_forecast, generation, recipe

    if args.machines < 1:
        raise ValueError(f"--machines: expected at least 1, got {args.machines}")
    whole = recipe.load(args.recipe)
    wanted = dataclasses.replace(whole, jobs=tuple(generation.shard(whole.jobs, args.shard)))
    with bar("planning", "kind") as progress:
        found = cost_forecast.forecast(wanted, frames=args.frames, progress=progress)
    facts = {"recipe": wanted.name, "digest": wanted.digest, "machines": args.machines}
    facts["hours_each"] = found.hours_each(args.machines)
    output(args, facts | found.to_dict(), found.lines(args.machines) if wanted.jobs else _empty(whole, ()))
    return 0


def add_recipes(sub: Any) -> None:
    """Add the command `recipes` to a program."""
    parser = command(
        sub,
        "recipes",
        _run_recipes,
        "List the shipped recipes and what each one makes, or print one.",
        "qsim recipes\nqsim recipes --print starter > mine.toml\nqsim recipes --keys",
    )
    instead = parser.add_mutually_exclusive_group()
    instead.add_argument("--print", metavar="NAME", help="print the text of this recipe")
    instead.add_argument("--keys", action="store_true", help="print the keys of a recipe, and what each accepts")


def _run_recipes(args: argparse.Namespace) -> int:
    from qsim.dataset import recipe
    from qsim.scenes import RECIPES

    if args.keys:
        print_keys(args, documented_keys.of_recipes())
        return 0
    if args.print is not None:
        path, text = recipe.text_of(args.print)
        text = text.replace('"sensors/', f'"{path.resolve().parent}/sensors/')  # a copy elsewhere finds them too
        output(args, {"recipe": str(path), "text": text}, text.rstrip("\n"))
        return 0
    found = {name: recipe.load(name) for name in RECIPES}
    made = {name: {"clips": len(one.jobs), "file": str(RECIPES[name])} for name, one in found.items()}
    width = max(map(len, found))
    lines = [f"{name:{width}}  {_contents(one.jobs)}" for name, one in found.items()]
    output(args, {"recipes": made}, [*lines, "qsim generate NAME makes one; qsim recipes --print NAME prints its text"])
    return 0


def print_keys(args: argparse.Namespace, sections: Mapping[str, Sequence[documented_keys.Key]]) -> None:
    """Print the keys of the sections of a file."""
    found = {section: [key._asdict() for key in keys] for section, keys in sections.items()}
    output(args, {"sections": found}, documented_keys.lines(sections))


def add_sensors(sub: Any) -> None:
    """Add the command `sensors` to a program."""
    parser = command(
        sub,
        "sensors",
        _run_sensors,
        "List the named sensors, or the keys of a sensor file.",
        "qsim sensors\nqsim sensors --keys",
    )
    parser.add_argument(
        "--keys", action="store_true", help="print the keys of a sensor file instead, and what each accepts"
    )


def _run_sensors(args: argparse.Namespace) -> int:
    from qsim.sensor.devices import DEVICES

    if args.keys:
        print_keys(args, documented_keys.of_sensor_files())
        return 0
    width = max(map(len, DEVICES))
    lines = [f"{name:{width}}  {device.what}" for name, device in DEVICES.items()]
    more = "qsim sense CLIP --sensor NAME draws with one; qsim doctor --devices prints every number with its source"
    output(args, {"sensors": {name: device.what for name, device in DEVICES.items()}}, [*lines, more])
    return 0


def _contents(jobs: Sequence[Job]) -> str:
    """Return the contents of a data set: `9 clips of 24 frames of 128 x 128 at 2000 fps; streams: ...`."""
    sizes = dict.fromkeys(
        f"{s.frames} frames of {s.height} x {s.width} at {s.frame_rate:g} fps" for s in (job.settings for job in jobs)
    )
    streams = dict.fromkeys(sensing.stream_name for job in jobs for sensing in job.streams)
    return f"{len(jobs)} clip{'s' * (len(jobs) != 1)} of {' or '.join(sizes)}; streams: {', '.join(streams) or 'none'}"


def add_check(sub: Any) -> None:
    """Add the command `check` to a program."""
    parser = command(
        sub,
        "check",
        _run_check,
        "Compare files with their checksums; exit code 1 if one is damaged.",
        "qsim check out/starter out/fan out/fan_restored.npy\nqsim check out/starter --redraw",
    )
    parser.add_argument("paths", nargs="+", type=Path, metavar="PATH", help="data sets, clips, streams, restored video")
    parser.add_argument(
        "--redraw",
        action="store_true",
        help="draw streams again with the reference engine and name those that differ; slow",
    )


def _run_check(args: argparse.Namespace) -> int:
    from qsim.dataset import checking

    problems: list[str] = []
    again: list[checking.Redrawn] = []
    for path in args.paths:
        with bar(str(path), "clip" if (path / "dataset.json").is_file() else "file") as progress:
            problems += checking.check(path, progress)
        if args.redraw:
            with bar(f"{path} again", "stream") as progress:
                again += checking.redraw(path, progress)
    names = ", ".join(str(path) for path in args.paths)
    facts: dict[str, Any] = {"paths": [str(path) for path in args.paths], "problems": problems}
    lines = checking.lines(problems, names)
    if args.redraw:
        facts["redrawn"] = [dataclasses.asdict(one) | {"path": str(one.path), "wrong": one.wrong} for one in again]
        lines += checking.redrawn_lines(again)
    output(args, facts, lines)
    return 1 if problems or any(one.wrong for one in again) else 0
