"""Measures the cost of a restored frame: seconds, memory and multiply-accumulates, beside its PSNR.

    methods x modes x precisions, on one fixed synthetic clip -> table, figure, JSON

Every case runs in a separate process, so that its peak memory is measured alone. Multiply-accumulates are those of
convolutions and matrix products, as torch counts them; sampling and classical methods are not counted. Presets whose
weights do not ship run with random weights: their cost is real, their PSNR is left out.
"""

from __future__ import annotations

import math
import multiprocessing
import time
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.checks import suggest
from qsim.figures import new_figure, write_figure
from qsim.files import Progress
from qsim.keys import Key
from qsim.tables import markdown_table
from quiver.data.clips import peak_of
from quiver.data.code_table import draw_codes
from quiver.data.codes import Codes, array_codes
from quiver.data.illumination import Illumination
from quiver.device import PeakMemory, pick_device
from quiver.evaluation import metrics
from quiver.model.names import NETWORKS, QUIVERS
from quiver.restoration.interface import MODES, RestoreOptions, Restorer
from quiver.restoration.networks import network_restorer, wrap_network
from quiver.restoration.restorers import is_classical, restorer, runs_on_any_device, weights_path

EXPOSURE = 5e-4  # s
LONG = 10.0  # s; the first run of a process took 7 % longer than the second at 2.5 s, and no longer at 17 s
MODAL = (*QUIVERS, "quiver-s-1m")  # presets that have several modes


@dataclass(frozen=True)
class CostCase:
    """One method, run in one way."""

    method: str
    mode: str = "exact"
    precision: str = "float32"


@dataclass(frozen=True)
class CostSettings:
    """The fixed clip, and the frames of it that are timed."""

    height: int = 64
    width: int = 64
    frames: int = 26  # of the clip
    restored: int = 16  # in its middle: all that have five neighbours on both sides
    ppp: float = 3.25
    device: str = "auto"
    threads: int | None = None  # of torch on the CPU; None = torch's own choice


@dataclass(frozen=True)
class CostRow:
    """The cost of a case; NaN where it could not be measured."""

    method: str
    mode: str
    precision: str
    trained: bool
    seconds_per_frame: float
    peak_bytes: int  # above the process before the run (CPU), allocated (CUDA)
    gmac_per_frame: float
    psnr_matched: float  # dB; NaN without trained weights
    threads: int | None = None  # of torch
    failure: str | None = None


def fixed_clip(settings: CostSettings) -> tuple[Codes, Array]:
    """Return codes of waves and a disk that move 2 px per frame, and their photons [T, H, W]; never to be changed."""
    sensor = Illumination.of(ppp=settings.ppp).device(EXPOSURE)
    y, x = np.mgrid[: settings.height, : settings.width].astype(float)
    frames = []
    for t in range(settings.frames):
        moved = x - 2 * t
        waves = np.sin(0.31 * moved + 0.2 * y) + np.sin(0.83 * moved - 0.4 * y) + np.sin(0.15 * y + 1)
        disk = (moved % settings.width - settings.width / 2) ** 2 + (y - settings.height / 2) ** 2
        frames.append(1 + 0.2 * waves + 0.8 * (disk < (settings.height / 5) ** 2))
    photons = np.stack(frames)
    photons *= settings.ppp / photons.mean()
    codes = draw_codes(sensor, photons, EXPOSURE, Key(seed=0, clip=0))
    return array_codes(codes, sensor, EXPOSURE, name="fixed clip"), photons


def method_of(case: CostCase, device: str) -> tuple[Restorer, bool]:
    """Return the restorer of a case, and whether it has trained weights (or needs none)."""
    import torch

    from quiver.model.presets import build

    options = RestoreOptions(mode=case.mode, precision=case.precision, device=device)
    if is_classical(case.method):
        return restorer(case.method, options), True
    try:
        path = weights_path(case.method)
    except ValueError:
        if case.method not in NETWORKS:
            raise
        torch.manual_seed(0)
        return wrap_network(build(case.method), case.method, "random weights", options), False
    return network_restorer(path, options), True


def measure(case: CostCase, settings: CostSettings) -> CostRow:
    """Run one case in this process: two frames, or a part, for its memory, which does not grow with the clip; then all.

    A part that takes more than LONG is not run again.
    """
    import torch

    if settings.threads is not None:
        torch.set_num_threads(settings.threads)
    codes, photons = fixed_clip(settings)
    method, trained = method_of(case, settings.device)
    if method.together > 1:  # one part, with frames before and after it
        settings = replace(settings, frames=3 * method.together, restored=method.together)
        codes, photons = fixed_clip(settings)
    first = (settings.frames - settings.restored) // 2
    last = first + settings.restored
    memory = PeakMemory(method.device)
    restored, seconds = _timed(method, codes, first, last if method.together > 1 else first + 2)
    peak = memory.bytes()
    if method.together == 1 or seconds < LONG:
        restored, seconds = _timed(method, codes, first, last)
    white = peak_of(settings.ppp)
    score = metrics.score(restored / white, photons[first:last] / white)
    return CostRow(
        **asdict(case),
        trained=trained,
        seconds_per_frame=seconds / settings.restored,
        peak_bytes=peak,
        gmac_per_frame=multiply_accumulates(method, codes, first) / 1e9 if method.learned else math.nan,
        psnr_matched=score.psnr_matched if trained else math.nan,
        threads=torch.get_num_threads(),
    )


def _timed(method: Restorer, codes: Codes, first: int, last: int) -> tuple[Array, float]:
    """Return restored frames, and the seconds they took."""
    started = time.perf_counter()
    restored = method.restore(codes, first, last)
    return restored, time.perf_counter() - started


def multiply_accumulates(method: Restorer, codes: Codes, first: int) -> float:
    """Return those of one more restored frame: the difference between restoring three frames and two.

    A network that restores several frames at a time: those of such a part, divided by its frames.
    """
    from quiver.evaluation.macs import MacCounter

    if method.together > 1:
        with MacCounter() as counter:
            method.restore(codes, first, first + method.together)
        return counter.total / method.together
    counts = []
    for frames in (2, 3):
        with MacCounter() as counter:
            method.restore(codes, first, first + frames)
        counts.append(counter.total)
    return counts[1] - counts[0]


def bench(cases: Sequence[CostCase], settings: CostSettings, progress: Progress | None = None) -> list[CostRow]:
    """Run every case in a new process; a case that fails keeps its row, with the reason."""
    costs = []
    for i, case in enumerate(cases):
        if progress is not None:
            progress(i, len(cases))
        costs.append(_in_own_process(case, settings))
    if progress is not None:
        progress(len(cases), len(cases))
    return costs


def _in_own_process(case: CostCase, settings: CostSettings) -> CostRow:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_child, args=(theirs, case, settings), daemon=True)
    process.start()
    theirs.close()
    found: CostRow | str
    told: list[str] = []
    try:
        found, told = ours.recv()
    except EOFError:
        process.join()
        found = f"its process crashed (exit code {process.exitcode}); check its memory"
    process.join()
    for text in dict.fromkeys(told):
        warnings.warn(f"{case.method}: {text}", stacklevel=3)
    if isinstance(found, CostRow):
        return found
    return CostRow(
        **asdict(case),
        trained=False,
        seconds_per_frame=math.nan,
        peak_bytes=0,
        gmac_per_frame=math.nan,
        psnr_matched=math.nan,
        failure=found,
    )


def _child(pipe: Any, case: CostCase, settings: CostSettings) -> None:
    found: CostRow | str
    with warnings.catch_warnings(record=True) as told:
        try:
            found = measure(case, settings)
        except Exception as error:  # a failure is recorded as its result
            found = f"{type(error).__name__}: {' '.join(str(error).split())}"
    pipe.send((found, [str(warning.message) for warning in told]))


def cases_of(methods: Sequence[str], modes: Sequence[str], precisions: Sequence[str]) -> list[CostCase]:
    """Return all combinations. Classical methods have one mode and precision, all networks but QUIVER one mode: those
    of a case.
    """
    cases = []
    for method in methods:
        classical = is_classical(method)
        for mode in (CostCase.mode,) if classical or _has_one_mode(method) else modes:
            chosen = (CostCase.precision,) if classical else precisions
            cases += [CostCase(method, mode, precision) for precision in chosen]
    return cases


def _has_one_mode(network: str) -> bool:
    from quiver.model.quiver import QUIVER
    from quiver.model.weights import load

    try:
        path = weights_path(network)
    except ValueError:  # a preset without weights
        return network not in MODAL
    return not isinstance(load(path), QUIVER)


def checked_cases(
    methods: Sequence[str], modes: Sequence[str] | None, precisions: Sequence[str] | None, device: str | None
) -> list[CostCase]:
    """Return `cases_of` with the defaults for None. `ValueError` for unknown names and options without effect."""
    from quiver.model.weights import load

    networks = [method for method in methods if not is_classical(method)]
    for method in methods:
        if method not in networks:
            restorer(method)
        elif method not in NETWORKS:
            load(weights_path(method))
    _check_known("modes", modes, MODES)
    _check_known("precisions", precisions, ("float32", "bfloat16"))
    for option, value in (("modes", modes), ("precisions", precisions)):
        if value is not None and not networks:
            raise ValueError(f"{option}=: acts on networks, and {', '.join(methods)} is classical; leave it out")
    if modes is not None and networks and all(_has_one_mode(network) for network in networks):
        raise ValueError(f"modes=: acts on QUIVER, {', '.join(networks)} has one mode; leave it out")
    if any(runs_on_any_device(method) for method in methods):
        pick_device(device or "auto")
    elif device is not None:
        raise ValueError(f"device=: {', '.join(methods)} computes where it will; leave it out")
    return cases_of(methods, modes or ("exact", "streaming"), precisions or ("float32",))


def _check_known(option: str, given: Sequence[str] | None, known: Sequence[str]) -> None:
    """Raise `ValueError` for a name that is none of the known ones."""
    for name in given or ():
        if name not in known:
            raise ValueError(f"{option}=: no {name!r}{suggest(name, known)}; known are {', '.join(known)}")


def device_of(cases: Sequence[CostCase], wanted: str | None) -> str:
    """Return the device of the cases; that of methods of others is not known, and taken as the CPU."""
    chosen = any(runs_on_any_device(case.method) for case in cases)
    return pick_device(wanted or "auto") if chosen else "cpu"


def markdown(costs: Sequence[CostRow], settings: CostSettings) -> str:
    """Return the result as a Markdown table."""
    text = [
        f"# Cost of a restored frame: {settings.height} x {settings.width}, {settings.ppp:g} PPP, {settings.device}",
        "",
    ]
    table = []
    for c in costs:
        case = [c.method, c.mode, c.precision]
        if c.failure is not None:
            table.append([*case, f"failed: {c.failure}", "", "", ""])
            continue
        gmac = "-" if math.isnan(c.gmac_per_frame) else f"{c.gmac_per_frame:.3g}"
        psnr = "untrained" if math.isnan(c.psnr_matched) else f"{c.psnr_matched:.2f} dB"
        table.append([*case, f"{c.seconds_per_frame:.3g}", f"{c.peak_bytes / 1e6:.0f} MB", gmac, psnr])
    header = ("method", "mode", "precision", "s/frame", "peak memory", "GMAC/frame", "PSNR matched")
    return "\n".join([*text, *markdown_table(table, header)]) + "\n"


def figure(costs: Sequence[CostRow], path: Path) -> None:
    """Draw PSNR against seconds per frame as PNG; untrained networks are left out."""
    drawing = new_figure(6, 4)
    axes = drawing.subplots()
    for c in costs:
        if c.failure is None and not math.isnan(c.psnr_matched):
            axes.plot(c.seconds_per_frame, c.psnr_matched, "o", label=f"{c.method}, {c.mode}, {c.precision}")
    axes.set_xscale("log")
    if axes.lines:
        axes.legend(fontsize=7)
    axes.set_xlabel("seconds per frame")
    axes.set_ylabel("PSNR after the best factor [dB]")
    write_figure(drawing, path)
