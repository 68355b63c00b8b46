"""Compares what a shard was planned to cost with what it cost, and measures what its clips hold.

    python benchmarks/shard_cost.py --alone out/plan_alone.json --reuse out/plan.json     # the page of plans alone
    python benchmarks/shard_cost.py --shard-plan out/plan_shard.json --data out/i2        # adds the shard: a minute

Writes docs/results/i2.json, .md and .png. Parts that are not given are those that i2.json holds. Plans are the output
of `qsim plan --json`. What a clip cost is read from its log, which its worker writes when the clip is finished.
"""

from __future__ import annotations

import argparse
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from rows import processor
from shard_contents import contents
from shard_page import WAYS, draw, page

from qsim import files
from qsim.dataset import recipe
from qsim.dataset.cost_forecast import kinds_of
from qsim.dataset.dataset import Dataset
from qsim.dataset.generation import shard
from qsim.dataset.recipe import Recipe
from qsim.files import VERSION, read_json, write_bytes, write_json
from qsim.streams.clip import Clip
from qsim.words import part_of

ROOT = Path(__file__).parents[1]
FORMAT = "qsim-shard-1"


# ---- Plans


def variants(wanted: Recipe) -> dict[str, Recipe]:
    """Return the recipe with each frame alone and with frames that share samples, whatever it says itself."""
    return {"alone": with_reuse(wanted, False), "reuse": with_reuse(wanted, None)}


def with_reuse(wanted: Recipe, reuse: bool | None) -> Recipe:
    return replace(
        wanted, jobs=wanted.jobs.changed(lambda job: replace(job, settings=replace(job.settings, reuse=reuse)))
    )


def part(wanted: Recipe, which: tuple[int, int]) -> Recipe:
    """Return the recipe of the clips of one shard."""
    return replace(wanted, jobs=shard(wanted.jobs, which))


def read_plan(path: Path, wanted: dict[str, Recipe], what: str) -> dict[str, Any]:
    """Return what a plan says of one of the recipes `wanted`, and its way; `ValueError` if it is of none of them."""
    plan = read_json(path)
    way = next((way for way, each in wanted.items() if each.digest == plan.get("digest")), None)
    if way is None:
        raise ValueError(f"{path}: is not the plan of {what}; make it with `qsim plan --json` of this version")
    try:
        kinds = [
            {key: kind[key] for key in ("family", "clips", "samples", "neighbours")} | cost_of_clip(kind)
            for kind in plan["kinds"]
        ]
        return {"way": way, **totals_of(plan), "kinds": kinds}
    except (KeyError, TypeError) as error:
        raise ValueError(f"{path}: lacks {error}; make it again with `qsim plan --json`") from None


def totals_of(plan: dict[str, Any]) -> dict[str, Any]:
    """Return the engine and the totals of a plan, and this machine."""
    totals = {"processor_hours": plan["processor_hours"], "wall_hours": plan["hours"], "gigabytes": plan["gigabytes"]}
    totals |= {"memory": plan["peak_memory_gib"] * 2**30 / 1e9}
    return {"engine": plan["engine"], "processor": processor(), **totals}


def cost_of_clip(kind: dict[str, Any]) -> dict[str, float]:
    """Return the mean processor hours, wall hours and GB of a clip of a kind, without the start of its worker."""
    frames = kind["frames"] / kind["clips"]
    hours = {
        f"{clock}_hours": (
            kind["setup_seconds"][clock] + frames * (kind["per_frame_seconds"][clock] + kind["sensing_seconds"][clock])
        )
        / 3600
        for clock in ("processor", "wall")
    }
    return hours | {"gigabytes": frames * kind["frame_bytes"] / 1e9}


def kind_of(wanted: Recipe) -> dict[str, int]:
    """Return the number of each clip's kind in a plan."""
    return {job.name: number for number, jobs in enumerate(kinds_of(wanted)) for job in jobs}


# ---- The shard


def read_shard(path: Path, wanted: dict[str, Recipe], what: str) -> dict[str, Any]:
    """Return what the clips of a shard cost and hold; `ValueError` if it is unfinished or of another recipe."""
    data = Dataset.open(path)
    way = next((way for way, each in wanted.items() if all(data.holds(job) for job in each.jobs)), None)
    if way is None:
        raise ValueError(f"{path}: was made from another recipe than {what}")
    names = sorted(job.name for job in wanted[way].jobs)
    done = set(data.names())
    if missing := [name for name in names if name not in done]:
        left = f"{len(missing)} of {len(names)} clips are not made yet, the first is {missing[0]}"
        raise ValueError(f"{path}: {left}; run `qsim generate` again")
    clips = {name: cost(path, name) | contents(Clip.open(path / "clips" / name)) for name in names}
    return {"way": way, "processor": processor(), "clips": clips}


def cost(path: Path, name: str) -> dict[str, float]:
    """Return what a clip cost, from its log and its files; `ValueError` if its log does not hold all of it."""
    log = path / "logs" / f"{name}.log"
    text = log.read_text(encoding="utf-8")
    done = re.findall(r" clip ([\d.]+) s, streams ([\d.]+) s, processor ([\d.]+) s, peak (\d+) MiB", text)
    if text.count(" rendering on ") != 1 or len(done) != 1:
        raise ValueError(f"{log}: the clip was not made in one run, so its cost is unknown; use another folder")
    rendering, sensing, worked, peak = map(float, done[0])
    size = sum(file.stat().st_size for file in (path / "clips" / name).rglob("*") if file.is_file())
    hours = {"processor_hours": worked / 3600, "wall_hours": (rendering + sensing) / 3600}
    return hours | {"gigabytes": size / 1e9, "memory": peak * 2**20 / 1e9}


# ---- Commands


def gather(args: argparse.Namespace) -> dict[str, Any]:
    """Return what the given files hold, and of missing ones what the stored json holds."""
    wanted = recipe.load(args.recipe)
    ways = variants(wanted)
    parts = {way: part(each, args.shard) for way, each in ways.items()}
    name = f"{args.recipe}"
    written = "{}/{}".format(*args.shard)
    kinds = kind_of(ways["alone"]), kind_of(parts["alone"])
    if not kinds[1]:
        raise ValueError(
            f"{name} has {len(wanted.jobs)} clips, and shard {written} none of them; choose another --shard"
        )
    same = {"format": FORMAT, "recipe": wanted.name, "digest": ways["alone"].digest, "part": written}
    stored = args.out.with_suffix(".json")
    old: dict[str, Any] = read_json(stored) if stored.is_file() else {"plans": {}, **same}
    if any(old.get(key) != value for key, value in same.items()):
        raise ValueError(f"{stored}: is not of shard {written} of {name}; choose another --out")
    plans = dict(old["plans"])
    if args.alone is not None:
        plans["alone"] = read_plan(args.alone, {"alone": ways["alone"]}, f"{name} with reuse = false")
    if args.reuse is not None:
        plans["reuse"] = read_plan(args.reuse, {"reuse": ways["reuse"]}, f"{name} without reuse")
    if args.shard_plan is not None:
        plans["shard"] = read_plan(args.shard_plan, parts, f"shard {written} of {name}")
    made = old.get("made") if args.data is None else read_shard(args.data, parts, name)
    if made is not None and "shard" in plans and plans["shard"]["way"] != made["way"]:
        plan = WAYS[plans["shard"]["way"]]
        clips = WAYS[made["way"]]
        raise ValueError(f"the shard was planned for {plan}, and made with {clips}; plan the recipe that made it")
    found = {**same, "qsim": VERSION, "clips": len(wanted.jobs), "plans": plans}
    found["shard"] = {clip: {"whole": kinds[0][clip], "shard": kinds[1][clip]} for clip in sorted(kinds[1])}
    return found if made is None else found | {"made": made}


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recipe", default="i2_2000fps", help="a .toml file or a name (default i2_2000fps)")
    parser.add_argument("--alone", type=Path, help="plan of the recipe with reuse = false")
    parser.add_argument("--reuse", type=Path, help="plan of the recipe, which may share")
    parser.add_argument("--shard-plan", type=Path, help="plan of the shard")
    parser.add_argument("--data", type=Path, help="data set folder that holds the shard")
    parser.add_argument("--shard", type=part_of, default=(1, 100), metavar="I/N", help="default 1/100")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results" / "i2", help="without suffix")
    args = parser.parse_args(words)
    try:
        found = gather(args)
    except (ValueError, OSError) as error:
        print(f"shard_cost: {files.wording(error)}", file=sys.stderr)
        return 2
    args.out.parent.mkdir(parents=True, exist_ok=True)
    write_json(args.out.with_suffix(".json"), found)
    write_bytes(args.out.with_suffix(".md"), page(found, args.out.with_suffix(".png").name).encode())
    if "made" in found:
        draw(found["made"]["clips"], args.out.with_suffix(".png"))
    print(f"{args.out.with_suffix('.md')}: written")
    return 0


if __name__ == "__main__":
    sys.exit(main())
