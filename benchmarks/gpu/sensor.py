"""Measures how fast codes are drawn, and that all engines draw the same: compiled engines, NumPy, torch."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from typing import Any

from job import Absent, Job, median_seconds
from sizes import Sizes

THREE_BITS = "3-bit codes"
ONE_BIT = "1-bit codes"
PACKED = f"{ONE_BIT}, packed"
# s; expected photons per pixel of the 3-bit and the 1-bit sensor
EXPOSURE = 5e-4
PHOTONS = 3.25
PLANE_PHOTONS = 0.7


def names(sizes: Sizes) -> list[str]:
    """Return a measurement for each engine, from host to host and on its device, and for the usual lines of torch."""
    return ["engine-cuda", "engine-llvm", "device-cuda", "device-llvm", "torch-cpu", "torch-cuda"]


def measure(job: Job) -> list[dict[str, Any]]:
    """Return rows of Gpixel/s, and for engines the largest share of codes that differ from the reference's."""
    kind, _, where = job.name.partition("-")
    if kind == "torch":
        return _torch(where, job.sizes)
    os.environ["QSIM_ENGINE"] = where
    from qsim import backend

    try:
        backend.choose()
    except ValueError as error:
        raise Absent(str(error)) from None
    return _engine(where, job.sizes) if kind == "engine" else _on_device(where, job.sizes)


def _row(by: str, what: str, gigapixels: float, **more: Any) -> dict[str, Any]:
    empty = {"times NumPy": None, "differing per million": None}
    return {"by": by, "what": what, "Gpixel/s": gigapixels} | empty | more


def _engine(where: str, sizes: Sizes) -> list[dict[str, Any]]:
    from qsim.studies.validation import sensors

    report = sensors.run(sizes.sensor_pixels)
    by = {(row.model, row.engine): row for row in report.rows}
    different = max(row.mismatches_per_million or 0.0 for row in report.rows)
    rows = []
    for what, model in ((THREE_BITS, "QIS 3 bits, gain 1.077"), (PACKED, "clocked SPAD, 1 bit, packed")):
        numpy = by[model, "numpy"]
        fast = by[model, "fast"]
        host = f"{what}, from host to host"
        rows.append(_row("numpy", host, numpy.megapixels_per_second / 1e3))
        more = {"times NumPy": fast.times_numpy, "differing per million": fast.mismatches_per_million}
        rows.append(_row(where, host, fast.megapixels_per_second / 1e3, **more))
    checks = {"differing per million": different, "all checks": "passed" if report.ok else "NOT passed"}
    rows.append({"by": where, "what": "all sensors, the largest difference; `qsim validate sensor`"} | checks)
    return rows


def _on_device(where: str, sizes: Sizes) -> list[dict[str, Any]]:
    """Return the speed of draws that stay on the device, and compare their codes with those that come to the host."""
    import numpy as np

    from qsim import Key
    from qsim.sensor.devices import quiver_physical
    from qsim.sensor.spad import BinarySPAD

    try:
        import torch

        from qsim.sensor.row import Row
        from quiver.data.device_codes import codes_of_rows, codes_on_device
        from quiver.device import wait
    except ModuleNotFoundError as error:
        return [{"by": where, "what": f"{THREE_BITS}, on the device: not measured, {error.name} is not installed"}]
    sensor = quiver_physical(PHOTONS)
    key = Key(0, 1)
    height = sizes.height
    width = sizes.width
    light = np.random.default_rng(0).uniform(
        0, 2 * PHOTONS, (max(1, sizes.sensor_pixels // height // width), height, width)
    )
    light = light.astype(np.float32)
    place = torch.device("cuda" if where == "cuda" and torch.cuda.is_available() else "cpu")
    photons = torch.from_numpy(light).to(place)
    codes = codes_on_device(sensor, photons, EXPOSURE, key=key)
    different = float(np.mean(codes.cpu().numpy() != sensor.sample(light, EXPOSURE, key=key)))
    found = []
    for start, given in (("host", light), ("device", photons)):
        seconds = median_seconds(lambda given=given: codes_on_device(sensor, given, EXPOSURE, key=key), sizes.rounds)
        what = f"{THREE_BITS}, from {start} to a torch tensor on {codes.device.type}"
        found.append(_row(where, what, light.size / seconds / 1e9, **{"differing per million": 1e6 * different}))
    batch = photons.unsqueeze(1)  # each frame a window with a key of its own
    for what, device in ((THREE_BITS, sensor), (ONE_BIT, BinarySPAD(0.5, 25.0))):
        rows = [Row(device, EXPOSURE, key.at(t)) for t in range(len(batch))]
        expected = device.sample(light, EXPOSURE, key=key)
        for packed in (False, True)[: 1 + (device.bits == 1)]:
            drawn = codes_of_rows(batch, rows, packed)[:, 0].cpu().numpy()
            drawn = np.unpackbits(drawn, axis=-1, count=width) if packed else drawn
            wrong = float(np.mean(drawn != expected))
            draw = partial(codes_of_rows, batch, rows, packed)
            seconds = median_seconds(draw, sizes.rounds, lambda: wait(place))
            form = f"{what}, packed," if packed else what
            label = f"{form} of {len(rows)} windows in one launch, from device to a torch tensor on {codes.device.type}"
            found.append(_row(where, label, light.size / seconds / 1e9, **{"differing per million": 1e6 * wrong}))
    return found


def _torch(where: str, sizes: Sizes) -> list[dict[str, Any]]:
    """Return the speed of the usual lines in torch: Poisson plus Gaussian, rounded and clipped; random < p, packed."""
    import torch

    from qsim.sensor.devices import quiver_physical
    from qsim.sensor.spad import BinarySPAD
    from quiver.device import wait

    if where == "cuda" and not torch.cuda.is_available():
        raise Absent("torch finds no CUDA device here")
    place = torch.device(where)
    sensor = quiver_physical(PHOTONS)
    plane = BinarySPAD(0.5, 25.0)
    shape = (max(1, sizes.sensor_pixels // sizes.height // sizes.width), sizes.height, sizes.width)
    rate = torch.full(shape, float(sensor.arrivals(PHOTONS, EXPOSURE)), device=place)
    share = torch.full(shape, float(1 - plane.cdf(PLANE_PHOTONS, EXPOSURE)[0]), device=place)
    powers = (2 ** torch.arange(7, -1, -1)).to(place, torch.uint8)

    def codes() -> torch.Tensor:
        electrons = torch.poisson(rate) + sensor.read_noise * torch.randn_like(rate)
        return (sensor.gain * electrons).round_().clamp_(0, sensor.levels - 1).to(torch.uint8)

    def planes() -> torch.Tensor:
        bits = (torch.rand_like(share) < share).view(*shape[:-1], -1, 8)
        return (bits.to(torch.uint8) * powers).sum(-1, dtype=torch.uint8)

    works: tuple[tuple[str, Callable[[], torch.Tensor]], ...] = ((THREE_BITS, codes), (PACKED, planes))
    rows = []
    for what, work in works:
        seconds = median_seconds(work, sizes.rounds, lambda: wait(place))
        rows.append(_row(f"torch, {where}", f"{what}, on the device", rate.numel() / seconds / 1e9))
    return rows
