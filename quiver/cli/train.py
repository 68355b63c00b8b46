"""The commands `quiver train` (one network) and `quiver ablate` (six): their options and actions."""

from __future__ import annotations

import argparse
import math
import os
import signal
import sys
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from qsim import checks
from qsim.cli.console import WITHOUT_FORCE, failed, note, output
from qsim.cli.options import check_free, checked, count, nonnegative, positive
from quiver.cli.options import (
    PROTOCOLS,
    add_noise,
    add_preset,
    add_running,
    add_threads,
    command,
    handling,
    running_options,
    use_threads,
)
from quiver.device import DEVICES
from quiver.restoration.interface import NETWORKS, QUIVERS
from quiver.training.saving import WHEN

# train

DIVERGED = 3  # exit code of a run whose loss became NaN or infinite


def add_train(sub: Any) -> None:
    parser = command(
        sub,
        "train",
        _run_train,
        "Train a network on the clips of a data set; rerun the same command to resume.",
        "quiver train out/starter -o out/mine --minutes 20\n"
        "quiver train out/starter -o out/unet --preset unet --protocol control --minutes 20\n"
        "torchrun --nproc-per-node 4 -m quiver train out/starter -o out/s --preset quiver-s --protocol published",
        resumes=True,
    )
    parser.add_argument(
        "data",
        nargs="+",
        help="data set folder, or several, whose clips count alike; for bit2bit a stored stream, or a clip with one",
    )
    parser.add_argument("-o", "--output", required=True, help=f"folder of the run; its state is {WHEN}")
    add_preset(parser, "mergenet", NETWORKS)
    parser.add_argument(
        "--protocol",
        default="quick",
        choices=PROTOCOLS,
        help="bundle of defaults (default quick); compared networks have quick and published",
    )
    parser.add_argument("--start", help="weights to start from: a name that ships, a weights file or a run folder")
    parser.add_argument("--steps", type=count, help="optimiser steps")
    parser.add_argument("--minutes", type=positive, help="wall-clock limit; the learning rate follows it")
    add_noise(parser)
    parser.add_argument("--crop", type=count, help="px, side of the training windows")
    parser.add_argument(
        "--frames",
        type=count,
        help="frames of a training window (default: the protocol's, mostly 11; of 16, QUIVER restores six)",
    )
    parser.add_argument("--batch", type=count, help="windows per step and process")
    parser.add_argument("--optimiser", choices=("adam", "muon"), help="optimiser (default: the protocol's)")
    parser.add_argument("--learning-rate", type=positive, help="highest learning rate")
    parser.add_argument("--schedule", choices=("cosine", "plateau"), help="schedule of the learning rate")
    parser.add_argument(
        "--loss",
        choices=("published", "paper", "l1", "scales-l1"),
        help="of quiver and unet; default: the protocol's; compared networks have their own",
    )
    parser.add_argument("--validate-every", type=count, help="steps between validations")
    parser.add_argument(
        "--validation-split", choices=("train", "val", "test"), help="split to validate on (default val)"
    )
    parser.add_argument("--workers", type=nonnegative, help="processes that draw samples (default 0: this one)")
    add_threads(parser)
    parser.add_argument(
        "--precision",
        choices=("auto", "float32", "bfloat16"),
        help="precision (default auto: bfloat16 on CUDA; published protocols: float32)",
    )
    parser.add_argument("--device", default="auto", choices=DEVICES, help="device (default auto)")
    parser.add_argument("--seed", type=checked(checks.seed), help="of weights, samples and noise (default 0)")
    parser.add_argument("--force", action="store_true", help="replace an existing run")


def _run_train(args: argparse.Namespace) -> int:
    import torch

    from quiver import threads
    from quiver.data.clips import split_clips
    from quiver.device import pick_device
    from quiver.model.weights import digest
    from quiver.restoration.restorers import weights_path
    from quiver.training.loop import Diverged, train
    from quiver.training.run_folder import draw_curve

    if args.force:
        args.after_interrupt = WITHOUT_FORCE

    first = None if args.start is None else weights_path(args.start)
    args.start = None if first is None else digest(first)
    args.data = args.data[0] if len(args.data) == 1 else tuple(args.data)
    settings = _settings(args)
    if args.preset.startswith("bit2bit"):
        settings = _of_stream(args, settings)
    if args.validate_every is not None and settings.steps is None:
        raise ValueError(
            "--validate-every: counts steps of a run with --steps; a run that --minutes ends is validated "
            "after every tenth of its time; leave it out"
        )
    if args.validation_split is not None and not split_clips(settings.data, args.validation_split)[1]:
        raise ValueError(
            f"--validation-split {args.validation_split}: {', '.join(settings.folders)} has no clip in that split; "
            "leave it out, and without clips in `val` training clips serve"
        )
    folder = Path(settings.out)
    leads = os.environ.get("RANK", "0") == "0"
    earlier = None if args.force else threads.recorded(folder / "settings.json")
    settings = replace(settings, threads=use_threads(args, earlier))
    torch.manual_seed(settings.seed)
    interrupted: list[int] = []
    try:
        with _signals(interrupted):
            state = train(
                network_of(args, settings, first),
                settings,
                device=pick_device(args.device),
                should_stop=lambda: bool(interrupted),
                progress=not (args.json or args.quiet),
                force=args.force,
                note=note,
            )
    except Diverged as error:
        return failed(f"quiver: {error}", DIVERGED, args.json and leads)
    if leads:
        draw_curve(folder, state.history)
        output(args, *_summary(folder, state))
    if interrupted:
        print(f"quiver: interrupted; {args.after_interrupt}", file=sys.stderr)
        return 130
    return 0


def _settings(args: argparse.Namespace) -> Any:
    """Return the protocol's settings, replaced by the options that are given."""
    from quiver.training.settings import Settings
    from quiver.training.system import protocol
    from quiver.training.systems import system_named

    given = {field.name: getattr(args, field.name, None) for field in fields(Settings)}
    given |= {"data": args.data, "out": args.output, "network": args.preset}
    defaults = dict(protocol(system_named(args.preset), args.protocol))
    if any(sensor.endswith(".toml") for sensor in args.sensor or ()):
        defaults.pop("bits", None)  # a sensor file states its own; a named sensor beside it has those of the streams
    return Settings(**defaults | {name: value for name, value in given.items() if value is not None})


def _of_stream(args: argparse.Namespace, settings: Any) -> Any:
    """Return the settings with the light of a stream; `ValueError` for options that act on data sets alone."""
    from quiver.data.stream_windows import stream_at
    from quiver.restoration.sources import refuse
    from quiver.training.self_supervised import own_light

    names = ("sensor", "ppp", "bits", "validate_every", "validation_split")
    refuse(args, names, f"is for data sets, and {args.preset} learns from one stream")
    if len(settings.folders) > 1:
        raise ValueError(f"{', '.join(settings.folders)}: {args.preset} learns from one stream; give one")
    return own_light(settings, stream_at(Path(settings.folders[0])))


def network_of(args: argparse.Namespace, settings: Any, first: Path | None = None) -> Any:
    """Return the network of the preset with random weights, or those of the file `first`; bit2bit for the law of its
    stream. `ValueError` for weights of another network.
    """
    from quiver.data.stream_windows import stream_at
    from quiver.model import weights
    from quiver.model.presets import build
    from quiver.model.rivals.bit2bit import Bit2Bit
    from quiver.training.self_supervised import config_for

    network = build(args.preset)
    if isinstance(network, Bit2Bit):
        network = Bit2Bit(config_for(stream_at(Path(settings.folders[0])), network.config))
    if first is None:
        return network
    loaded = weights.load(first)
    if type(loaded) is not type(network) or loaded.config != network.config:
        raise ValueError(
            f"--start {first}: weights of {type(loaded).__name__} with another configuration than the "
            f"preset {args.preset}; name the preset that they were trained with"
        )
    return loaded.train()


def _signals(found: list[int]) -> AbstractContextManager[None]:
    """Collect Ctrl-C and termination instead of ending: the loop ends after its step and saves its state."""
    return handling(lambda number, _: found.append(number), signal.SIGINT, signal.SIGTERM)


def _summary(folder: Path, state: Any) -> tuple[dict[str, Any], str]:
    from quiver.evaluation.json_values import json_safe

    found = {"run": str(folder), "steps": state.step, "seconds": state.elapsed}
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


# ablate


def add_ablate(sub: Any) -> None:
    parser = command(
        sub,
        "ablate",
        _run_ablate,
        "Train the network in six versions, without some of its parts, and compare them.",
        "quiver ablate out/starter -o out/ablation --minutes 20",
        resumes=True,
    )
    parser.add_argument("data", help="data set folder")
    parser.add_argument("-o", "--output", required=True, help="folder of the six runs and their table")
    add_preset(parser, "quiver-s", QUIVERS)
    parser.add_argument("--protocol", default="quick", choices=PROTOCOLS, help="bundle of defaults (default quick)")
    parser.add_argument("--steps", type=count, help="optimiser steps of each")
    parser.add_argument("--minutes", type=positive, help="wall-clock limit of each")
    add_noise(parser)
    parser.add_argument("--crop", type=count, help="px, side of the training windows")
    parser.add_argument("--batch", type=count, help="windows per step and process")
    parser.add_argument(
        "--split", default="test", choices=("train", "val", "test"), help="split to score on (default test)"
    )
    parser.add_argument("--seed", type=checked(checks.seed), help="of weights, samples and noise (default 0)")
    add_running(parser)


def _run_ablate(args: argparse.Namespace) -> int:
    from quiver import threads
    from quiver.evaluation import summary
    from quiver.evaluation.comparison import Comparison
    from quiver.model.presets import ABLATIONS
    from quiver.training.ablation import markdown, one_noise, run_ablation
    from quiver.training.loop import Diverged

    check_free(Path(args.output))
    _check_scored(args.data, args.split)
    args.precision, precision = None, args.precision  # for restoring; training has another default
    settings = _settings(args)
    args.precision = precision
    first = Path(args.output) / next(iter(ABLATIONS)) / "settings.json"
    settings = replace(settings, threads=use_threads(args, threads.recorded(first)))
    try:
        settings, lines = one_noise(settings)
        for line in lines:
            note(line)
        lights = settings.noise or ()
        comparison = Comparison(args.data, args.split, lights, settings.seed)
        interrupted: list[int] = []
        found = run_ablation(
            settings,
            comparison,
            running_options(args),
            should_stop=lambda: bool(interrupted),
            while_training=_signals(interrupted),
            progress=not (args.json or args.quiet),
        )
    except Diverged as error:
        text = _without_force(error, "choose another --protocol or --seed, and another -o")
        return failed(f"quiver: {text}", DIVERGED, args.json)
    except (FileExistsError, ValueError) as error:
        if "--force" not in str(error):
            raise
        raise FileExistsError(_without_force(error, "choose another -o")) from error
    if found is None:
        return failed("quiver: interrupted; the same command resumes where it stopped", 130, args.json)
    methods, rows = found
    summary.write(Path(args.output) / "table", comparison, methods, rows)
    output(args, summary.as_dict(comparison, methods, rows), markdown(args.preset, rows))
    return 1 if any(row.failure for row in rows) else 0


def _check_scored(data: str, split: str) -> None:
    """Raise `ValueError` if there is nothing to score: no clip of the split, or only one that also trains."""
    from quiver.data.clips import split_clips

    if split_clips(data, split)[1]:
        return
    if (Path(data) / "clip.json").exists():
        raise ValueError(f"{data}: is one clip, which trains; give a data set with clips in split {split}")
    raise ValueError(f"--split {split}: {data} has no finished clip in that split; choose another one")


def _without_force(error: Exception, advice: str) -> str:
    """Return the text of an error; where its last clause advises --force, which `quiver ablate` lacks, with this advice
    instead.
    """
    text = str(error)
    kept, _, last = text.rpartition("; ")
    return f"{kept}; {advice}" if kept and "--force" in last else text
