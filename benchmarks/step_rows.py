"""Makes rows of equal steps: all that are missing at the same time, each in a process. Programs of rows import this.

Other programs on the machine make such rows late and change nothing in them. So no row is marked, and one GPU serves
all processes at once.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from typing import Any

from rows import Budget, machine, recipe_digest

from qsim.files import VERSION, write_json

VALIDATIONS = 5  # of a run
TRIAL = 6  # a trial of a learning rate has one in so many steps of a run
PLACE = ("--device", "auto", "--precision", "float32", "--workers", 1)


@dataclass(frozen=True)
class Steps(Budget):
    """What every row gets where all make the same number of steps."""

    minutes: float = 0.0  # not limited
    threads: int = 1
    batch: int = 8  # windows of a step: a GPU takes several in the time of one
    steps: int = 0

    @property
    def interval(self) -> int:
        """Steps between validations."""
        return max(1, self.steps // VALIDATIONS)

    def length(self, *, trial: bool = False) -> tuple[object, ...]:
        """Return the options of `quiver train` for where a run or a trial is made, and how long."""
        if trial:
            steps = max(1, self.steps // TRIAL)
            return (*PLACE, "--steps", steps, "--validate-every", steps)
        return (*PLACE, "--steps", self.steps, "--validate-every", self.interval)


def refuse_busy(args: argparse.Namespace) -> None:
    """Raise `ValueError` for an option that cannot act on rows of equal steps."""
    if args.busy:
        raise ValueError("--busy: rows of equal steps are made on any cores and never marked; leave it out")


def together(
    program: str,
    makers: Mapping[str, Callable[[], dict[str, Any]]],
    args: argparse.Namespace,
    budget: Steps,
    page: Callable[[], None],
) -> int:
    """Make the rows that are missing, each by its maker, then `page`; return 1 if one failed, 0 otherwise.

    `FileNotFoundError` if a row is missing and the data set too. The others are made if one fails.
    """
    missing = {name: make for name, make in makers.items() if not (args.out / f"{name}.json").exists()}
    if not missing:
        page()
        return 0
    if not args.data.is_dir():
        raise FileNotFoundError(f"{args.data}: no such data set")
    args.out.mkdir(parents=True, exist_ok=True)
    head = {"quiver": VERSION, "budget": asdict(budget), "data": args.data.name, "machine": machine()}
    head |= {"recipe_sha256": recipe_digest(args.data), "quiet": True}  # others change nothing in equal steps
    failed = 0
    with ProcessPoolExecutor(len(missing), mp_context=get_context("spawn")) as pool:
        made = {pool.submit(make): name for name, make in missing.items()}
        for future in as_completed(made):
            path = args.out / f"{made[future]}.json"
            try:
                own = future.result()
            except Exception as error:  # whatever it was, the other rows are made
                print(f"{program}: {made[future]}: {type(error).__name__}: {error}", file=sys.stderr)
                failed = 1
                continue
            write_json(path, head | own)
            print(f"{path}: written", flush=True)
            page()
    return failed
