"""Runs `qsim generate`, `plan` and `check` on data sets, and lists what they take: `qsim recipes`, `qsim sensors`."""

from __future__ import annotations

import dataclasses
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from qsim import plugins
from qsim.cli import documented_keys
from qsim.cli.command import Idle, command
from qsim.cli.completion import recipes as recipe_names
from qsim.cli.console import PILOT, RESUMES, bar, in_options, note, output, running
from qsim.dataset.job import Job
from qsim.dataset.jobs import Jobs
from qsim.dataset.recipe import Recipe
from qsim.kinds import Frames, NotNegative, Positive, Text, Whole
from qsim.rendering.render_settings import RenderSettings
from qsim.settings import setting
from qsim.words import part_of

Workers = Annotated[int, Meta(ge=0, le=100_000)]  # 0: in this process


@dataclass(frozen=True)
class Generate:
    """What `qsim generate` makes, where and with which processes."""

    recipe: Annotated[Path, setting("a .toml file, or a name of `qsim recipes`", positional=True, known=recipe_names)]
    output: Annotated[Path | None, setting("data set folder", unset="out/NAME of the recipe", short="o")] = None
    workers: Annotated[Workers | None, setting("processes, each with its own renderer", unset="1")] = None
    shard: Annotated[
        tuple[int, int] | None, setting("only the I-th of N parts, as in 7/100", shown="I/N", read=part_of)
    ] = None
    memory: Annotated[Positive | None, setting("memory limit of a process, GiB", unset="4")] = None
    retry: Annotated[bool, setting("try failed jobs again")] = False
    repair: Annotated[bool, setting("check all files, and make damaged ones again")] = False
    wait: Annotated[bool, setting("wait until no other generator uses the folder")] = False
    cluster: Annotated[
        Text | None, setting("address of a Dask scheduler, as in tcp://10.0.0.1:8786", shown="ADDRESS")
    ] = None
    gpus: Annotated[NotNegative, setting("GPU resource that each job takes on the cluster")] = 0


def _elsewhere(option: str) -> str:
    return (
        "number, memory and lifetime of the workers of --cluster are set where they are started, with "
        f"`dask worker --{option}`"
    )


IDLE = (
    Idle(
        lambda asked: (
            "acts on processes of this machine; start Dask workers with QSIM_THREADS=N instead" if asked.cluster else ""
        ),
        ("threads",),
    ),
    Idle(lambda asked: _elsewhere("nworkers") if asked.cluster else "", ("workers",)),
    Idle(lambda asked: _elsewhere("memory-limit") if asked.cluster else "", ("memory",)),
    Idle(lambda asked: "" if asked.cluster else "needs --cluster, whose workers state their GPUs", ("gpus",)),
    Idle(lambda asked: "bounds worker processes, and --workers 0 has none" if asked.workers == 0 else "", ("memory",)),
)


@command(
    "qsim generate starter -o out/starter --workers 2",
    "qsim generate mine.toml -o /data/mine --shard 7/100",
    after_interrupt=RESUMES,
    threads="threads of the renderer (Dr.Jit) in each worker",
    idle=IDLE,
)
def generate(asked: Generate) -> int:
    """Make the clips and streams that are missing, and report failed jobs."""
    from qsim.dataset import generation, recipe
    from qsim.dataset.worker_pool import Limits

    wanted = recipe.load(asked.recipe)
    folder = running().target = asked.output or Path("out") / wanted.name
    count = generation.Options.workers if asked.workers is None else asked.workers
    limits = Limits() if asked.memory is None else Limits(memory=asked.memory)
    options = generation.Options(count, asked.shard, asked.retry, asked.repair, asked.wait, limits)
    chosen = generation.shard(wanted.jobs, asked.shard)
    with bar(wanted.name, first=PILOT) as progress, generation.watching(folder, chosen, progress):
        summary = generation.generate(wanted, folder, options, run=_cluster(asked))
    lines = [f"{folder}: {summary.done} of {summary.jobs} clips done, {summary.made} made now{_defaults(wanted)}"]
    lines += _empty(wanted, chosen)
    lines += [f"repaired {problem}" for problem in summary.repaired]
    lines += [f"FAILED {name}: {why}" for name, why in sorted(summary.failed.items())]
    lines += [f"SHARED {problem}" for problem in summary.shared]
    lines += _reached(folder, chosen)
    if summary.failed:
        lines.append("run again with --retry after removing the cause")
    output({"dataset": str(folder)} | dataclasses.asdict(summary), lines)
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


def _reached(folder: Path, jobs: Jobs) -> list[str]:
    """Return which limit, dB or PPP, decided the samples of how many finished clips, and which missed their error."""
    from qsim.clip.clamped_error import stated
    from qsim.clip.manifest import read_info
    from qsim.rendering.budget import deciding
    from qsim.rendering.fidelity import shortfall

    limits: Counter[str] = Counter()
    missed = []
    for job in jobs:
        path = folder / "clips" / job.key / "clip.json"
        if not path.is_file():
            continue
        info = read_info(path)
        if info.render and (limit := deciding(info.render.findings)):
            limits[limit] += 1
        if why := shortfall(stated(info), job.settings.psnr):
            missed.append(f"{job.name} reached {why}")
    counted = ", ".join(f"{limit} in {clips} clip{'s' * (clips != 1)}" for limit, clips in sorted(limits.items()))
    return [*([f"the samples follow from {counted}"] if limits else []), *missed]


def _cluster(asked: Generate) -> Any:
    """Return the cluster of --cluster or None."""
    if asked.cluster is None:
        return None
    if not re.fullmatch(r"(\w+://)?[^/\s]+:\d+", asked.cluster):
        raise ValueError(f"--cluster {asked.cluster}: is not the address of a scheduler, as tcp://10.0.0.1:8786 is")
    from qsim.dataset.dask_cluster import Cluster

    if not asked.cluster.startswith("tls://"):
        note(
            f"{asked.cluster}: without TLS, so anyone who can reach this port can run any program as its workers' user"
        )
    return Cluster(asked.cluster, gpus=asked.gpus)


@dataclass(frozen=True)
class Plan:
    """The recipe whose cost is forecast."""

    recipe: Annotated[Path, setting("a .toml file, or a name of `qsim recipes`", positional=True, known=recipe_names)]
    machines: Annotated[Whole, setting("number of machines that share the work")] = 10
    frames: Annotated[Frames, setting("frames rendered per kind")] = 5
    shard: Annotated[
        tuple[int, int] | None, setting("only the I-th of N parts, as in 7/100", shown="I/N", read=part_of)
    ] = None


@command("qsim plan i2_2000fps --machines 10", threads="threads of the renderer (Dr.Jit)")
def plan(asked: Plan) -> int:
    """Print what each kind of job costs, and all of them."""
    from qsim.dataset import cost_forecast, generation, recipe

    whole = recipe.load(asked.recipe)
    wanted = dataclasses.replace(whole, jobs=generation.shard(whole.jobs, asked.shard))
    with bar("planning", "kind") as progress:
        found = cost_forecast.forecast(wanted, frames=asked.frames, progress=progress)
    facts = {"recipe": wanted.name, "digest": wanted.digest, "machines": asked.machines}
    facts["hours_each"] = found.hours_each(asked.machines)
    output(facts | found.to_dict(), found.lines(asked.machines) if wanted.jobs else _empty(whole, ()))
    return 0


@dataclass(frozen=True)
class Recipes:
    """What `qsim recipes` prints."""

    print: Annotated[Text | None, setting("print the text of this recipe", shown="NAME", known=recipe_names)] = None
    keys: Annotated[bool, setting("print the keys of a recipe, and what each accepts")] = False


@command(
    "qsim recipes",
    "qsim recipes --print starter > mine.toml",
    "qsim recipes --keys",
    idle=[Idle(lambda asked: "not allowed with --print, which prints a recipe" if asked.print else "", ("keys",))],
)
def recipes(asked: Recipes) -> int:
    """Print the recipes, one of them, or the keys of all."""
    from qsim.dataset import recipe
    from qsim.scenes import RECIPES

    if asked.keys:
        print_keys(documented_keys.of_recipes())
        return 0
    if asked.print is not None:
        path, text = recipe.text_of(asked.print)
        text = text.replace('"sensors/', f'"{path.resolve().parent}/sensors/')  # a copy elsewhere finds them too
        output({"recipe": str(path), "text": text}, text.rstrip("\n"))
        return 0
    found = {name: recipe.load(name) for name in RECIPES}
    made = {name: {"clips": len(one.jobs), "file": str(RECIPES[name])} for name, one in found.items()}
    width = max(map(len, found))
    lines = [f"{name:{width}}  {_contents(one.jobs)}" for name, one in found.items()]
    output({"recipes": made}, [*lines, "qsim generate NAME makes one; qsim recipes --print NAME prints its text"])
    return 0


def print_keys(sections: Mapping[str, Sequence[documented_keys.Key]]) -> None:
    """Print the keys of the sections of a file."""
    found = {section: [key._asdict() for key in keys] for section, keys in sections.items()}
    output({"sections": found}, documented_keys.lines(sections))


@dataclass(frozen=True)
class Sensors:
    """What `qsim sensors` prints."""

    keys: Annotated[bool, setting("print the keys of a sensor file instead, and what each accepts")] = False


@command("qsim sensors", "qsim sensors --keys")
def sensors(asked: Sensors) -> int:
    """Print the named sensors, or the keys of a sensor file."""
    from qsim.sensor.devices import DEVICES
    from qsim.sensor.event_camera import CAMERAS

    if asked.keys:
        print_keys(documented_keys.of_sensor_files())
        return 0
    known = {name: device.what for name, device in DEVICES.items()}
    known |= dict.fromkeys(plugins.installed(plugins.SENSORS), "of an installed package")
    events = {name: camera.what for name, camera in CAMERAS.items()}
    width = max(map(len, known | events))
    lines = [f"{name:{width}}  {what}" for name, what in (known | events).items()]
    more = (
        f"qsim sense CLIP --sensor NAME draws with one, qsim events CLIP --camera NAME with {' or '.join(events)}; "
        "qsim doctor --devices prints every number of a sensor with its source"
    )
    output({"sensors": known, "event_cameras": events}, [*lines, more])
    return 0


def _contents(jobs: Jobs) -> str:
    """Return the contents of a data set: `9 clips of 24 frames of 128 x 128 at 2000 fps; streams: ...`."""
    kinds = [part[0] for part in jobs.by_section()]
    sizes = dict.fromkeys(
        f"{s.frames} frames of {s.height} x {s.width} at {s.frame_rate:g} fps" for s in (job.settings for job in kinds)
    )
    streams = dict.fromkeys(sensing.stream_name for job in kinds for sensing in job.streams)
    return f"{len(jobs)} clip{'s' * (len(jobs) != 1)} of {' or '.join(sizes)}; streams: {', '.join(streams) or 'none'}"


@dataclass(frozen=True)
class Check:
    """What `qsim check` compares."""

    paths: Annotated[
        tuple[Path, ...],
        setting("data sets, also published, clips, streams, restored video", shown="PATH", positional=True),
    ]
    shard: Annotated[
        tuple[int, int] | None,
        setting("only the I-th of N parts of a data set, as in 7/100", shown="I/N", read=part_of),
    ] = None
    redraw: Annotated[
        bool, setting("draw streams again with the reference engine and name those that differ; slow")
    ] = False


@command(
    "qsim check out/starter out/fan out/fan_restored.npy",
    "qsim check out/starter --redraw",
    "qsim check /data/mine --shard 7/100",
)
def check(asked: Check) -> int:
    """Print the problems of all files; return 1 if there are any."""
    from qsim.dataset import checking
    from qsim.publishing.published_set import PublishedSet, is_published

    problems: list[str] = []
    again: list[checking.Redrawn] = []
    for path in asked.paths:
        if is_published(path):
            with bar(str(path), "shard") as progress:
                problems += PublishedSet.open(path).verify(progress, asked.shard)
            continue
        with bar(str(path), "clip" if (path / "dataset.json").is_file() else "file") as progress:
            problems += checking.check(path, progress, asked.shard)
        if asked.redraw:
            with bar(f"{path} again", "stream") as progress:
                again += checking.redraw(path, progress, asked.shard)
    names = ", ".join(str(path) for path in asked.paths)
    facts: dict[str, object] = {"paths": [str(path) for path in asked.paths], "problems": problems}
    lines = checking.lines(problems, names)
    if asked.redraw:
        facts["redrawn"] = [dataclasses.asdict(one) | {"path": str(one.path), "wrong": one.wrong} for one in again]
        lines += checking.redrawn_lines(again)
    output(facts, [in_options(line) for line in lines])
    return 1 if problems or any(one.wrong for one in again) else 0
