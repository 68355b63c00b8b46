"""Compares what a GPU computes with the CPU: codes, merged inputs, classical methods, training windows, a network.

Every measurement is small: a minute tells whether the figures of speed that follow are those of the same program.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from job import Job

METHODS = ("naive", "moment", "likelihood", "transform-denoise", "qbp", "qbp-bm3d")
SEED = 1


def names(sizes: Any) -> list[str]:
    """Return the parts that are compared, in order of worth."""
    import torch  # noqa: F401  (without it nothing is compared)

    return list(PARTS)


def measure(job: Job) -> list[dict[str, Any]]:
    """Return a row for everything that is compared."""
    return PARTS[job.name](job)


def _place() -> Any:
    import torch

    from quiver.device import pick_device

    return torch.device(pick_device("auto"))


def _row(what: str, found: Any, expected: Any, unit: float = 1.0, share: str = "of white") -> dict[str, Any]:
    """Return how far two arrays differ, as a share of `unit`."""
    import numpy as np

    apart = np.abs(np.asarray(found, np.float64) - np.asarray(expected, np.float64)) / unit
    return {
        "compared with the CPU": what,
        "device": _place().type,
        "numbers": apart.size,
        "differing per million": 1e6 * float(np.mean(apart > 0)),
        f"largest difference [% {share}]": 100 * float(apart.max()),
    }


def _codes(job: Job) -> list[dict[str, Any]]:
    """Return codes of every sensor, drawn in one launch of two windows, and by NumPy."""
    import numpy as np
    import torch

    from qsim import QIS, Key
    from qsim.sensor.row import Row
    from qsim.sensor.spad import BinarySPAD
    from quiver.data.device_codes import codes_of_rows

    side = job.sizes.compared_side
    light = np.random.default_rng(SEED).gamma(0.7, 4, (2, 8, side, side)).astype(np.float32)
    rows = []
    for sensor in (*(QIS(0.8, 1.6, 0.2, bits) for bits in (1, 3, 5, 7)), BinarySPAD(0.5, 25.0)):
        asked = [Row(sensor, 5e-4, Key(SEED, clip)) for clip in range(2)]
        found = codes_of_rows(torch.from_numpy(light).to(_place()), asked).cpu().numpy()
        expected = np.stack([sensor.sample(light[n], 5e-4, key=asked[n].key, engine="reference") for n in range(2)])
        rows.append(
            _row(
                f"codes of {type(sensor).__name__}, {sensor.bits} bits",
                found,
                expected,
                sensor.levels - 1,
                "of the top code",
            )
        )
    return rows


def _merge(job: Job) -> list[dict[str, Any]]:
    """Return the merged frame of mergenet and the inputs of its network."""
    import torch

    from quiver.baselines.domain_tables import domain_tables
    from quiver.baselines.information_domain import information_domain
    from quiver.restoration.merge_inputs import inputs_of_windows

    codes = _moving(job)
    window = torch.from_numpy(codes.read(0, 11)[None])
    domain = information_domain(codes.sensor, codes.exposure)
    found, expected = (
        inputs_of_windows(window.to(place), domain_tables(domain, place)) for place in (_place(), torch.device("cpu"))
    )
    top = float(domain.phi[-1])
    return [
        _row("phi of merged frames", found.phi.cpu(), expected.phi, top, "of its range"),
        _row("inputs of mergenet", found.channels.cpu(), expected.channels, 1.0, "of four deviations"),
    ]


def _classical(job: Job) -> list[dict[str, Any]]:
    """Return restored frames by the classical methods."""
    from quiver.restoration.interface import RestoreOptions
    from quiver.restoration.restorers import restorer

    codes = _moving(job)
    rows = []
    for name in METHODS:
        found, expected = (
            restorer(name, RestoreOptions(device=kind)).restore(codes, 5, 7) / codes.white
            for kind in (_place().type, "cpu")
        )
        rows.append(_row(f"restored by {name}", found, expected))
    return rows


def _windows(job: Job) -> list[dict[str, Any]]:
    """Return codes and targets of training windows."""
    from steps import clips_of_pattern
    from torch.utils.data import default_collate

    from quiver.data.device_windows import DeviceWindows
    from quiver.data.windows import Windows, WindowSettings
    from quiver.device import light_memory

    windows = Windows(clips_of_pattern(job), WindowSettings(crop=16, drift=3, seed=SEED))
    place = _place()
    held = DeviceWindows(windows, place, light_memory(place))
    found = held.draw(default_collate([held.places[n] for n in range(8)]))
    expected = default_collate([windows[n] for n in range(8)])
    return [_row(f"{name} of training windows", found[name].cpu(), expected[name]) for name in ("codes", "target")]


def _network(job: Job) -> list[dict[str, Any]]:
    """Return the first scale of quiver-s with random weights, float32."""
    import torch

    from quiver.model.presets import build

    torch.manual_seed(SEED)
    network = build("quiver-s").eval()
    codes = torch.rand(1, 11, 1, 32, 32)
    with torch.inference_mode():
        expected = network(codes).scale1
        found = network.to(_place())(codes.to(_place())).scale1.cpu()
    return [_row("quiver-s in float32", found, expected)]


def _moving(job: Job) -> Any:
    """Return 3-bit codes of a texture that slides."""
    import numpy as np

    from qsim import Key
    from qsim.sensor.devices import quiver_physical
    from quiver.data.codes import array_codes

    side = max(24, job.sizes.compared_side)
    rng = np.random.default_rng(SEED)
    texture = rng.gamma(2, 2, (side // 4 + 8, side // 4 + 8)).repeat(4, 0).repeat(4, 1)
    light = np.stack([texture[t : t + side, 2 * t : 2 * t + side] for t in range(13)])
    sensor = quiver_physical(3.25)
    return array_codes(sensor.sample(light, 5e-4, key=Key(SEED, 0)), sensor, 5e-4)


PARTS: dict[str, Callable[[Job], list[dict[str, Any]]]] = {
    "codes": _codes,
    "merge": _merge,
    "classical": _classical,
    "windows": _windows,
    "network": _network,
}
