"""Renders the same frames with every backend that works here, and compares seconds and mean radiance.

    run(families) -> BackendReport: one BackendRow per backend (CUDA, LLVM, scalar) and scene

A frame is radiance and ground truth. The time outside compiled kernels is our overhead.

Every backend renders the same scene with the same budget in a separate process. The means over all pixels and frames
may differ by their Monte-Carlo errors only.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from statistics import median

import numpy as np

from qsim import backend as engine
from qsim.rendering.budget import Budget
from qsim.rendering.engine import kernels_timed
from qsim.tables import text_table

FRAMES = 4  # timed frames, after a first one that compiles
BUDGET = Budget(samples=32, bounces=4)
DEVIATIONS = 5.0  # standard errors; chance exceeds them once in two million comparisons


@dataclass(frozen=True)
class BackendRow:
    """One backend on one scene."""

    engine: str
    scene: str
    seconds: float  # per frame, median
    outside: float | None  # share of the seconds without a compiled kernel; None: the backend has none
    mean: float  # radiance over all frames and pixels, W m^-2 sr^-1
    mean_error: float  # its standard error

    def deviation(self, other: BackendRow) -> float:
        """Return the difference of the means in standard errors of the difference."""
        return abs(self.mean - other.mean) / max(math.hypot(self.mean_error, other.mean_error), 1e-12 * self.mean)


@dataclass(frozen=True)
class BackendReport:
    """All rows, scene by scene, and why the other backends are missing."""

    height: int
    width: int
    samples: int
    rows: tuple[BackendRow, ...]
    missing: dict[str, str]

    def reference(self, row: BackendRow) -> BackendRow:
        """Return the row that others of the scene are compared with: that of the last of BACKENDS, scalar."""
        return next(r for r in reversed(self.rows) if r.scene == row.scene)

    @property
    def ok(self) -> bool:
        """Whether all means agree."""
        return all(row.deviation(self.reference(row)) <= DEVIATIONS for row in self.rows)

    def to_dict(self) -> dict[str, object]:
        """Return the report for JSON."""
        rows = []
        for row in self.rows:
            plain = self.reference(row)
            rows.append(asdict(row) | {"deviation": row.deviation(plain), "ratio": plain.seconds / row.seconds})
        return asdict(self) | {"rows": rows, "ok": self.ok}


def run(
    families: Sequence[str], *, height: int, width: int, seed: int, progress: Callable[[str], None] | None = None
) -> BackendReport:
    """Render a few frames of each family with every backend that works here; scalar always does."""
    rows: list[BackendRow] = []
    missing: dict[str, str] = {}
    for backend in engine.BACKENDS:
        try:
            engine.choose(backend)
        except ValueError as error:
            missing[backend] = str(error)
            continue
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:  # a process has one variant
            for family in families:
                if progress is not None:
                    progress(f"{backend}: {family}")
                rows.append(pool.submit(_measure, backend, family, height, width, seed).result())
    rows.sort(key=lambda row: (families.index(row.scene), engine.BACKENDS.index(row.engine)))
    return BackendReport(height, width, BUDGET.samples, tuple(rows), missing)


def _measure(backend: str, family: str, height: int, width: int, seed: int) -> BackendRow:
    """Time one backend on one scene; runs in a separate process, because a process selects its backend once."""
    os.environ["QSIM_ENGINE"] = backend
    from qsim import scenes
    from qsim.rendering.renderer import Renderer

    renderer = Renderer(scenes.load(family, seed=seed).resized(height, width), budget=BUDGET)
    seconds = []
    outside = []
    frames = []
    for t in range(FRAMES + 1):
        with kernels_timed() as inside:
            started = time.perf_counter()
            frames.append(renderer.frame(t))
            seconds.append(time.perf_counter() - started)
        outside.append(1 - sum(inside) / seconds[-1])
    radiance = np.stack([frame.radiance for frame in frames]).astype(np.float64)
    error = math.sqrt(sum(frame.error**2 for frame in frames) / len(frames) / radiance.size)
    share = None if backend == "scalar" else median(outside[1:])
    return BackendRow(backend, family, median(seconds[1:]), share, float(radiance.mean()), error)


def table(report: BackendReport) -> str:
    """Return the rows as text, and why backends are missing."""
    lines = [f"{report.height} x {report.width} pixels, {report.samples} samples; seconds per frame with ground truth"]
    rows = []
    for row in report.rows:
        plain = report.reference(row)
        off = "" if row is plain else f"{row.deviation(plain):.1f} std. errors"
        mean = f"{row.mean:.5g} +- {row.mean_error:.1g}"
        ratio = plain.seconds / row.seconds
        outside = "" if row.outside is None else f"{row.outside:.1%}"
        rows.append((row.scene, row.engine, f"{row.seconds:.3f}", f"{ratio:.1f}", outside, mean, off))
    header = ("scene", "engine", "s/frame", "faster", "outside kernels", "mean radiance", "off by")
    lines += text_table(rows, header, left=2)
    lines += [f"{backend}: {why}" for backend, why in report.missing.items()]
    lines.append(f"means agree within {DEVIATIONS:g} standard errors: {'yes' if report.ok else 'NO'}")
    return "\n".join(lines)
