"""Measures every method on a large frame: frames per second and memory, and the error of each precision."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from job import Job
from sizes import Sizes
from train import PRECISIONS, networks


def names(sizes: Sizes) -> list[str]:
    """Return all networks in each precision, then the classical methods."""
    from quiver.baselines import METHODS

    return [*(f"{network}-{precision}" for network in learned() for precision in PRECISIONS), *METHODS]


def learned() -> list[str]:
    """Return the networks of the project that restore: those that are trained here, and those of `quiver bench`."""
    from quiver.model.names import NETWORKS

    return list(dict.fromkeys([*networks(), *(name for name in NETWORKS if not name.endswith("-as-published"))]))


def measure(job: Job) -> list[dict[str, Any]]:
    """Return one row: frames per second, memory, and the difference from float32 on the CPU."""
    from quiver import threads
    from quiver.baselines import METHODS
    from quiver.device import pick_device
    from quiver.evaluation.cost import CostCase, CostSettings
    from quiver.evaluation.cost import measure as measure_cost

    classical = job.name in METHODS
    kind = pick_device("auto")
    sizes = job.sizes
    name, _, precision = (job.name, "", "float32") if classical else job.name.rpartition("-")
    source, weights = (name, "none needed") if classical else weights_of(job.out, name)
    case = CostCase(source, "exact", precision)
    restored = sizes.restored_slow if kind == "cpu" else sizes.restored
    settings = CostSettings(
        sizes.height, sizes.width, frames=restored + 10, restored=restored, device=kind, threads=threads.use().number
    )
    cost = measure_cost(case, settings)
    row = {
        "method": name,
        "precision": precision,
        "device": kind,
        "weights": weights,
        "size": f"{sizes.height} x {sizes.width}",
        "frames per s": 1 / cost.seconds_per_frame,
        "peak memory [MB]": cost.peak_bytes / 1e6,
        "GMAC per frame": None if classical else cost.gmac_per_frame,
    }
    return [row | _error(case, kind, sizes)]


def weights_of(out: Path, network: str) -> tuple[str, str]:
    """Return what to restore with: the run of this machine, else shipped weights, else random ones."""
    from quiver.restoration.restorers import shipped_names

    trained = out / "runs" / f"{network}-float32" / "best.safetensors"
    if trained.is_file():
        return str(trained), "trained here"
    return network, "shipped" if network in shipped_names() else "random"


def _error(case: Any, kind: str, sizes: Sizes) -> dict[str, Any]:
    """Return the difference of a few restored frames from those of float32 on the CPU [% of white]."""
    import numpy as np

    from quiver.evaluation.cost import CostSettings, fixed_clip, method_of

    codes, _ = fixed_clip(CostSettings(sizes.compared_side, sizes.compared_side, frames=13))
    found, exact = (
        method_of(one, device)[0].restore(codes, 5, 8) / codes.white
        for one, device in ((case, kind), (replace(case, precision="float32"), "cpu"))
    )
    difference = np.abs(found - exact)
    return {
        "rms from float32 on cpu [% of white]": 100 * float(np.sqrt(np.mean(difference**2))),
        "largest [% of white]": 100 * float(difference.max()),
    }
