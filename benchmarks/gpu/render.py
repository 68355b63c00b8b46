"""Measures rendering with CUDA beside LLVM: equal light, seconds per frame, and against a naive loop."""

from __future__ import annotations

import os
import time
from statistics import median
from typing import Any

from job import Absent, Job
from sizes import Sizes

ENGINES = ("cuda", "llvm")
SEED = 3


def names(sizes: Sizes) -> list[str]:
    """Return scene by scene: all engines together; then by engine, the validation and the time of a frame."""
    parts = ("engines", *(f"{what}-{engine}" for what in ("frame", "validate") for engine in ENGINES))
    return [f"{part}-{family}" for family in sizes.families for part in parts]


def measure(job: Job) -> list[dict[str, Any]]:
    """Return the rows of a measurement."""
    what, _, rest = job.name.partition("-")
    if what == "engines":
        return _engines(rest, job.sizes)
    engine, _, family = rest.partition("-")
    os.environ["QSIM_ENGINE"] = engine
    from qsim import backend

    try:
        backend.choose()
    except ValueError as error:
        raise Absent(str(error)) from None
    return (_frame if what == "frame" else _validate)(engine, family, job.sizes)


def _engines(family: str, sizes: Sizes) -> list[dict[str, Any]]:
    """Return `qsim validate engines` of one scene."""
    from qsim.studies.validation import backends

    report = backends.run([family], height=sizes.height, width=sizes.width, seed=SEED)
    return [
        {
            "scene": family,
            "engine": row.engine,
            f"s per frame, {report.samples} samples": row.seconds,
            "outside kernels": row.outside,
            "mean radiance": row.mean,
            "off by [std. errors]": row.deviation(report.reference(row)),
            "equal": "yes" if report.ok else "NO",
        }
        for row in report.rows
    ]


def _frame(engine: str, family: str, sizes: Sizes) -> list[dict[str, Any]]:
    """Return the seconds per frame, with ground truth, at the wanted error."""
    import scenes
    from qsim.rendering.fidelity import choose_budget
    from qsim.rendering.renderer import Renderer

    scene = scenes.load(family, seed=SEED).resized(sizes.height, sizes.width)
    started = time.perf_counter()
    budget = choose_budget(scene, psnr=sizes.psnr)
    choosing = time.perf_counter() - started
    renderer = Renderer(scene, budget=budget)
    seconds = []
    for t in range(sizes.frames + 1):
        started = time.perf_counter()
        renderer.frame(t)
        seconds.append(time.perf_counter() - started)
    return [
        {
            "scene": family,
            "engine": engine,
            "size": f"{sizes.height} x {sizes.width}",
            "dB": sizes.psnr,
            "s per frame": median(seconds[1:]),
            "s first frame": seconds[0],
            "s choosing": choosing,
            "samples": budget.samples,
            "bounces": budget.bounces,
            "denoised": "yes" if budget.denoise else "no",
        }
    ]


def _validate(engine: str, family: str, sizes: Sizes) -> list[dict[str, Any]]:
    """Return `qsim validate render` of one scene at the wanted error."""
    import scenes
    from qsim.studies.validation import rendering

    scene = scenes.load(family, seed=SEED).resized(sizes.check_height, sizes.check_width)
    report = rendering.run([scene], levels=(rendering.AT_LEVEL,), reference_samples=sizes.reference_samples)
    row = report.rows[0]
    return [
        {
            "scene": family,
            "engine": engine,
            "size": f"{report.height} x {report.width}",
            "asked [dB]": row.level,
            "reached [dB]": row.psnr,
            "stated [dB]": row.stated_psnr,
            "s": row.seconds,
            "naive loop [dB]": row.naive_psnr,
            "naive loop [s]": row.naive_seconds,
            "times faster": row.ratio,
        }
    ]
