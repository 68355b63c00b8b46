"""Repeats the paper's ablation: trains six networks of similar capacity without some parts, and compares them.

for each of six combinations of pre-denoiser, flow and multi-scale outputs: train, then score on held-out clips
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path

import torch

from qsim.tables import markdown_table
from quiver.data.clips import unfinished
from quiver.device import pick_device
from quiver.evaluation.comparison import Comparison, ComparisonRow, evaluate
from quiver.evaluation.summary import summarise
from quiver.model.config import Config
from quiver.model.names import QUIVERS
from quiver.model.presets import ABLATIONS, PRESETS, ablated, parameter_count
from quiver.model.quiver import QUIVER
from quiver.restoration.interface import RestoreOptions, Restorer
from quiver.restoration.restorers import restorer
from quiver.training.loop import train
from quiver.training.run_folder import alone_in
from quiver.training.settings import Settings, settled

HEADER = ("pre-denoiser", "flow", "multi-scale", "parameters", "PSNR matched", "SSIM")


def networks(preset: str) -> dict[str, Config]:
    """Return the six configurations by name; ValueError if the preset has no ablation."""
    if preset not in QUIVERS:
        raise ValueError(f"no ablation of {preset!r}; there is one of {', '.join(QUIVERS)}")
    return {name: ablated(PRESETS[preset], name) for name in ABLATIONS}


def one_noise(settings: Settings) -> tuple[Settings, list[str]]:
    """Return the settings with the noise of all six networks, and lines about it and about missing clips.

    If the first network has been begun, its noise is kept. ValueError as in `settled`.
    """
    found, lines = settled(replace(settings, out=str(Path(settings.out) / next(iter(ABLATIONS)))))
    return replace(settings, noise=found.noise), lines + unfinished(settings.folders)


def run_ablation(
    settings: Settings,
    comparison: Comparison,
    options: RestoreOptions,
    *,
    should_stop: Callable[[], bool] = lambda: False,
    while_training: AbstractContextManager[object] | None = None,
    progress: bool = True,
) -> tuple[list[Restorer], list[ComparisonRow]] | None:
    """Train every combination in OUT/NAME (finished ones are kept), score them in OUT/table, and return the scores.

    None if `should_stop` ended it; the same call resumes it. Only training asks it, inside `while_training`. ValueError
    if the preset has no ablation.
    """
    out = Path(settings.out)
    out.mkdir(parents=True, exist_ok=True)
    with alone_in(out, "works"):
        with while_training or nullcontext():
            _train(settings, options, should_stop, progress)
        if should_stop():
            return None
        methods = [restorer(str(out / name), options) for name in ABLATIONS]
        return methods, evaluate(comparison, methods, out / "table")


def _train(settings: Settings, options: RestoreOptions, should_stop: Callable[[], bool], progress: bool) -> None:
    """Train one combination after the other, until `should_stop`."""
    for name, config in networks(settings.network).items():
        torch.manual_seed(settings.seed)
        network = QUIVER(config)
        own = replace(settings, out=str(Path(settings.out) / name), network=f"{settings.network} {name}")
        train(network, own, device=pick_device(options.device), should_stop=should_stop, progress=progress)
        if should_stop():
            return


def markdown(preset: str, rows: Sequence[ComparisonRow]) -> str:
    """Return the paper's table, one line per network and light level: parts, parameters, and means over scenes of the
    PSNR after the best factor and of SSIM.
    """
    configs = networks(preset)
    lines = summarise(rows)
    several = len({line.light for line in lines}) > 1
    header = (*HEADER[:4], "light", *HEADER[4:]) if several else HEADER
    table = []
    for line in lines:
        psnr = line.scores["psnr_matched"]
        ssim = line.scores["ssim"]
        cells = ["yes" if part else "no" for part in ABLATIONS[line.method]]
        cells += [f"{parameter_count(configs[line.method]):,}"]
        cells += [line.light] if several else []
        if psnr.scenes:
            cells += [f"{psnr.mean:.2f} dB", f"{ssim.mean:.3f}"]
        else:
            cells += ["failed" if line.failures else "n/a", ""]
        table.append(cells)
    return "\n".join(markdown_table(table, header)) + "\n"
