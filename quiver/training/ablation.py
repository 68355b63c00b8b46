"""The paper's ablation: the network without some of its parts, at similar capacity, as one command and one table.

for each of six combinations of pre-denoiser, flow and multi-scale outputs: train, then score on held-out clips

`nano` is taken without its initial estimate, which makes a picture from aligned frames before any of these parts acts
and would hide what they do.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from qsim.tables import markdown_table
from quiver.evaluation.comparison import Comparison, ComparisonRow, evaluate
from quiver.model.config import Config
from quiver.model.folded import FoldedConfig
from quiver.model.presets import ABLATIONS, PRESETS, ablated, assemble, parameter_count
from quiver.restoration.interface import RestoreOptions, Restorer
from quiver.restoration.networks import pick_device
from quiver.restoration.restorers import restorer
from quiver.training.loop import train
from quiver.training.run_folder import alone_in
from quiver.training.settings import Settings, settled

HEADER = ("pre-denoiser", "flow", "multi-scale", "parameters", "PSNR matched", "SSIM")


def networks(preset: str) -> dict[str, Config]:
    """The six by name; ValueError if the preset has no ablation."""
    if preset not in PRESETS:
        raise ValueError(f"no ablation of {preset!r}; there is one of {', '.join(PRESETS)}")
    whole = PRESETS[preset]
    if isinstance(whole, FoldedConfig):
        whole = replace(whole, estimate_width=0, largest_velocity=0.0)
    return {name: ablated(whole, name) for name in ABLATIONS}


def one_noise(settings: Settings) -> tuple[Settings, list[str]]:
    """The settings with the noise that all six share, that of the first one where it has begun; and lines that say it.

    ValueError as for `run.settled`.
    """
    found, lines = settled(replace(settings, out=str(Path(settings.out) / next(iter(ABLATIONS)))))
    return replace(settings, noise=found.noise), lines


def run_ablation(
    settings: Settings,
    comparison: Comparison,
    options: RestoreOptions,
    *,
    should_stop: Callable[[], bool] = lambda: False,
    progress: bool = True,
) -> tuple[list[Restorer], list[ComparisonRow]] | None:
    """Train every combination in OUT/NAME (finished ones are kept) and score them in OUT/table.

    None if `should_stop` ended it; the same call goes on. ValueError if the preset has no ablation.
    """
    out = Path(settings.out)
    out.mkdir(parents=True, exist_ok=True)
    with alone_in(out, "works"):
        return _run_ablation(settings, comparison, options, should_stop, progress)


def _run_ablation(
    settings: Settings, comparison: Comparison, options: RestoreOptions, should_stop: Callable[[], bool], progress: bool
) -> tuple[list[Restorer], list[ComparisonRow]] | None:
    out = Path(settings.out)
    for name, config in networks(settings.network).items():
        torch.manual_seed(settings.seed)
        network = assemble(config)
        own = replace(settings, out=str(out / name), network=f"{settings.network} {name}")
        train(network, own, device=pick_device(options.device), should_stop=should_stop, progress=progress)
        if should_stop():
            return None
    methods = [restorer(str(out / name), options) for name in ABLATIONS]
    return methods, evaluate(comparison, methods, out / "table")


def markdown(preset: str, rows: Sequence[ComparisonRow]) -> str:
    """The paper's table: what is built in, parameters, PSNR after the best factor and SSIM."""
    lines = []
    for name, config in networks(preset).items():
        scores = [row.score for row in rows if row.method == name and row.score is not None]
        cells = ["yes" if part else "no" for part in ABLATIONS[name]]
        cells.append(f"{parameter_count(config):,}")
        if scores:
            cells += [f"{sum(s.psnr_matched for s in scores) / len(scores):.2f} dB"]
            cells += [f"{sum(s.ssim for s in scores) / len(scores):.3f}"]
        else:
            cells += ["failed", ""]
        lines.append(cells)
    return "\n".join(markdown_table(lines, HEADER)) + "\n"
