"""The commands `quiver train` (one network) and `quiver ablate` (six): their options and actions."""

from __future__ import annotations

import math
import os
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from qsim.checks import ArgumentError
from qsim.cli.command import command
from qsim.cli.console import RESUMES, WITHOUT_FORCE, failed, note, output, running
from qsim.cli.options import check_free
from qsim.cli.signals import ENDING, handling
from qsim.files import Blocked, Damaged
from qsim.kinds import Split
from qsim.settings import setting
from quiver.cli.options import use_threads
from quiver.device import DEVICES
from quiver.model.names import QUIVERS
from quiver.restoration.interface import RestoreOptions
from quiver.training.settings import PROTOCOLS, Settings

if TYPE_CHECKING:
    from quiver.data.rendering import Rendering
    from quiver.training.schedule import State

DIVERGED = 3  # exit code of a run whose loss became NaN or infinite

# ---- train


@dataclass(frozen=True)
class Train:
    """How `quiver train` runs; what it trains are the `Settings`, whose defaults the protocol has."""

    protocol: Annotated[
        str, setting("bundle of defaults; compared networks have quick and published", choices=tuple(PROTOCOLS))
    ] = "quick"
    device: Annotated[str, setting("device", choices=DEVICES)] = "auto"
    force: Annotated[bool, setting("replace an existing run")] = False


@command(
    "quiver train out/starter -o out/mine --minutes 20",
    "quiver train out/starter -o out/unet --preset unet --protocol control --minutes 20",
    "torchrun --nproc-per-node 4 -m -- quiver train out/starter -o out/s --preset quiver-s --protocol published",
    after_interrupt=RESUMES,
)
def train(asked: Train, given: Annotated[dict[str, Any], Settings]) -> int:
    """Train, or resume a run; return 3 if it diverges."""
    if asked.force:
        running().after_interrupt = WITHOUT_FORCE
    interrupted: list[int] = []
    with ExitStack() as stack:
        stack.enter_context(_signals(interrupted))
        rendering = _rendering(given, lambda: bool(interrupted))
        if rendering is not None:
            given = given | {"data": str(rendering.folder)}
            stack.enter_context(rendering)
            note(f"{rendering.source}: is rendered into {rendering.folder} while the network learns")
            rendering.wait()
        return _trained(asked, given, rendering, interrupted)


def _rendering(given: Mapping[str, Any], should_stop: Callable[[], bool]) -> Rendering | None:
    """Return the data set to render meanwhile, if the data is a recipe; `ValueError` where that cannot be."""
    from quiver.data.rendering import Rendering, folder_of, is_recipe

    data = given["data"]
    sources = (data,) if isinstance(data, str) else data
    recipes = [source for source in sources if is_recipe(source)]
    if not recipes:
        return None
    source = recipes[0]
    if len(sources) > 1:
        raise ValueError(f"{source}: what is rendered meanwhile is the only data of a run; give the recipe alone")
    if str(given.get("network", Settings.network)).startswith("bit2bit"):
        raise ValueError(f"{source}: bit2bit learns from one stored stream; give a stream")
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        raise ValueError(
            f"{source}: one process trains while it renders; render first with `qsim generate`, or leave torchrun out"
        )
    run = Path(given["out"])
    folder = folder_of(source, run)
    if folder.resolve() == run.resolve():
        raise ValueError(f"{run}: the data set of {source} is rendered into this folder; choose another for the run")
    validation = given.get("validation_split", Settings.validation_split)
    return Rendering(source, folder, validation, should_stop=should_stop, note=note)


def _trained(asked: Train, given: dict[str, Any], rendering: Rendering | None, interrupted: list[int]) -> int:
    """Train, or resume a run; return 3 if it diverges."""
    import torch

    from quiver import threads
    from quiver.data.clips import split_clips
    from quiver.device import pick_device
    from quiver.model.weights import digest
    from quiver.restoration.restorers import weights_path
    from quiver.training import loop
    from quiver.training.loop import Diverged
    from quiver.training.run_folder import draw_curve

    first = weights_path(given["start"]) if "start" in given else None
    settings = settings_of_run(asked.protocol, given | ({} if first is None else {"start": digest(first)}))
    if settings.network.startswith("bit2bit"):
        settings = _of_stream(given, settings)
    elif "scan" in given:
        raise ArgumentError(
            "scan",
            "acts on a recording that a network learns from; the defects of drawn codes are known; leave it out",
            off=given["scan"] is False,
        )
    if "validate_every" in given and settings.steps is None:
        raise ValueError(
            "--validate-every: counts steps of a run with --steps; a run that --minutes ends is validated "
            "after every tenth of its time; leave it out"
        )
    if "validation_split" in given and not split_clips(settings.data, settings.validation_split)[1]:
        raise ValueError(
            f"--validation-split {settings.validation_split}: {', '.join(settings.folders)} has no clip in that split; "
            "leave it out, and without clips in `val` training clips serve"
        )
    folder = Path(settings.out)
    leads = os.environ.get("RANK", "0") == "0"
    earlier = None if asked.force else threads.recorded(folder / "settings.json")
    settings = replace(settings, threads=use_threads(settings.threads, earlier))
    torch.manual_seed(settings.seed)
    try:
        state = loop.train(
            network_of(settings, first),
            settings,
            device=pick_device(asked.device),
            should_stop=lambda: bool(interrupted),
            progress=not running().silent,
            force=asked.force,
            note=note,
            rendering=rendering,
        )
    except Diverged as error:
        text = f"{error.problem}; lower the learning rate and start again with --force"
        return failed(f"quiver: {text}", DIVERGED, running().printing.json and leads)
    if leads:
        draw_curve(folder, state.history)
        output(*_summary(folder, state))
    if interrupted:
        print(f"quiver: interrupted; {running().after_interrupt}", file=sys.stderr)
        return 130
    return 0


def settings_of_run(bundle: str, given: Mapping[str, Any]) -> Settings:
    """Return the settings of a protocol, replaced by those that are given."""
    from quiver.training.system import protocol
    from quiver.training.systems import system_named

    defaults: dict[str, Any] = dict(protocol(system_named(given.get("network", Settings.network)), bundle))
    if any(sensor.endswith(".toml") for sensor in given.get("sensor", ())):
        defaults.pop("bits", None)  # a sensor file states its own; a named sensor beside it has those of the streams
    if "planes" in given:
        defaults.pop("bits", None)  # those of a sum follow from its planes
    data = given["data"]
    if isinstance(data, tuple) and len(data) == 1:
        data = data[0]
    return Settings(**defaults | dict(given) | {"data": data})


def _of_stream(given: Mapping[str, Any], settings: Settings) -> Settings:
    """Return the settings with the light of a stream; `ArgumentError` for those that act on data sets alone."""
    from quiver.data.stream_windows import stream_at
    from quiver.training.self_supervised import own_light

    for name in ("sensor", "ppp", "bits", "planes", "temperature", "validate_every", "validation_split"):
        if name in given:
            why = f"is for data sets, and {settings.network} learns from one stream"
            raise ArgumentError(name, f"{why}; leave it out")
    if len(settings.folders) > 1:
        raise ValueError(f"{', '.join(settings.folders)}: {settings.network} learns from one stream; give one")
    codes = stream_at(Path(settings.folders[0]), settings.scan)
    if codes.scan:
        note(f"{codes.name}: {codes.scan}")
    return own_light(settings, codes)


def network_of(settings: Settings, first: Path | None = None) -> Any:
    """Return the network of the preset with random weights, or those of the file `first`; bit2bit for the law of its
    stream. `ValueError` for weights of another network.
    """
    from quiver.data.stream_windows import stream_at
    from quiver.model import weights
    from quiver.model.mosaic_network import MosaicNet
    from quiver.model.presets import build
    from quiver.model.rivals.bit2bit import Bit2Bit
    from quiver.training.self_supervised import config_for

    network = build(settings.network)
    if isinstance(network, Bit2Bit):
        network = Bit2Bit(config_for(stream_at(Path(settings.folders[0]), settings.scan), network.config))
    if first is None:
        return network
    loaded = weights.load(first)
    core: Any = loaded.core if isinstance(loaded, MosaicNet) else loaded
    if type(core) is not type(network) or core.config != network.config:
        raise ValueError(
            f"--start {first}: weights of {type(core).__name__} with another configuration than the "
            f"preset {settings.network}; name the preset that they were trained with"
        )
    return loaded.train()


def _signals(found: list[int]) -> AbstractContextManager[None]:
    """Collect Ctrl-C and termination instead of ending: the loop ends after its step and saves its state."""
    return handling(lambda number, _: found.append(number), signal.SIGINT, *ENDING)


def _summary(folder: Path, state: State) -> tuple[dict[str, object], str]:
    from quiver.evaluation.json_values import json_safe

    found: dict[str, object] = {"run": str(folder), "steps": state.step, "seconds": state.elapsed}
    text = f"{folder}: {state.step} steps in {state.elapsed / 60:.1f} min"
    weights = str(folder / "best.safetensors")
    if state.history:
        found |= {"best_psnr_matched": state.best, "weights": weights, "last_validation": state.history[-1]}
        best = f"best validation PSNR {state.best:.2f} dB (after the best factor)"
        text += f", {best if math.isfinite(state.best) else 'no validation has a finite PSNR'}: {weights}"
        text += _drop_after(state.best, state.history)
    elif state.finished:
        found |= {"weights": weights}
        text += f": {weights}"
    return json_safe(found), text


def _drop_after(best: float, history: Sequence[Mapping[str, float]]) -> str:
    """Return a second line if a curve [dB] ends below its best by more than what two digits show, else nothing."""
    last = history[-1]["psnr_matched"]
    if not last < best - 0.005:
        return ""
    known = [entry for entry in history if math.isfinite(entry["psnr_matched"])]
    minutes = max(known, key=lambda entry: entry["psnr_matched"])["elapsed"] / 60
    return (
        f"\nit then got worse: the last validation is {best - last:.2f} dB below the best, of minute {minutes:.1f}, "
        "whose weights are kept"
    )


# ---- ablate


@dataclass(frozen=True)
class Ablate:
    """Which network is trained without some of its parts, and on which clips the versions are compared."""

    data: Annotated[str, setting("data set folder", positional=True)]
    output: Annotated[str, setting("folder of the six runs and their table", short="o")]
    preset: Annotated[str, setting("network", choices=QUIVERS)] = "quiver-s"
    protocol: Annotated[str, setting("bundle of defaults", choices=tuple(PROTOCOLS))] = "quick"
    split: Annotated[Split, setting("split to score on")] = "test"


@command("quiver ablate out/starter -o out/ablation --minutes 20", after_interrupt=RESUMES)
def ablate(
    asked: Ablate,
    given: Annotated[
        dict[str, Any],
        Settings,
        *("steps", "minutes", "sensor", "ppp", "bits", "planes", "temperature", "crop", "batch", "seed", "threads"),
    ],
    options: RestoreOptions,
) -> int:
    """Train what is missing of the six runs, score them and print the table."""
    from quiver import threads
    from quiver.evaluation import summary
    from quiver.evaluation.comparison import Comparison
    from quiver.model.presets import ABLATIONS
    from quiver.training.ablation import markdown, one_noise, run_ablation
    from quiver.training.loop import Diverged

    check_free(Path(asked.output))
    _check_scored(asked.data, asked.split)
    settings = settings_of_run(
        asked.protocol, given | {"data": asked.data, "out": asked.output, "network": asked.preset}
    )
    first = Path(asked.output) / next(iter(ABLATIONS)) / "settings.json"
    settings = replace(settings, threads=use_threads(settings.threads, threads.recorded(first)))
    try:
        settings, lines = one_noise(settings)
        for line in lines:
            note(line)
        lights = settings.noise or ()
        comparison = Comparison(asked.data, asked.split, lights, settings.seed)
        interrupted: list[int] = []
        found = run_ablation(
            settings,
            comparison,
            options,
            should_stop=lambda: bool(interrupted),
            while_training=_signals(interrupted),
            progress=not running().silent,
        )
    except Diverged as error:  # the runs of an ablation are not replaced one by one
        text = f"{error.problem}; choose another --protocol or --seed, and another -o"
        return failed(f"quiver: {text}", DIVERGED, running().printing.json)
    except (Blocked, Damaged) as error:
        raise FileExistsError(f"{error.problem}; choose another -o") from error
    if found is None:
        return failed("quiver: interrupted; the same command resumes where it stopped", 130, running().printing.json)
    methods, rows = found
    summary.write(Path(asked.output) / "table", comparison, methods, rows)
    output(summary.as_dict(comparison, methods, rows), markdown(asked.preset, rows))
    return 1 if any(row.failure for row in rows) else 0


def _check_scored(data: str, split: str) -> None:
    """Raise `ValueError` if there is nothing to score: no clip of the split, or only one that also trains."""
    from quiver.data.clips import split_clips

    if split_clips(data, split)[1]:
        return
    if (Path(data) / "clip.json").exists():
        raise ValueError(f"{data}: is one clip, which trains; give a data set with clips in split {split}")
    raise ValueError(f"--split {split}: {data} has no finished clip in that split; choose another one")
