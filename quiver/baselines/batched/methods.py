"""Runs the classical methods on frames that lie on a device: each restores many frames at a time.

    codes [T, H, W] on a device -> groups of frames whose windows have the same shape -> restored [t, H, W] there

METHODS has the names of `quiver.baselines.METHODS`. Frames near the ends of a clip have shorter windows, so they are
groups of their own. A group is cut where memory does not hold it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import lru_cache, partial

import numpy as np
import torch
from numpy import ndarray as Array
from torch import Tensor

from qsim.sensor.sensor import Sensor
from quiver.baselines import few_codes, naive_mean, path_merge, qbp, sliding_window
from quiver.baselines.batched import bm3d, tables
from quiver.baselines.batched import likelihood as batched_likelihood
from quiver.baselines.batched import qbp as batched_qbp
from quiver.baselines.information_domain import information_domain
from quiver.baselines.sliding_window import check_window, checked_codes, equal_windows, look_ahead
from quiver.baselines.vst import Kind

# Restores frames [t, H, W], float32, of codes [T, H, W]; called with (codes, sensor, exposure, window, frames, memory)
Restore = Callable[[Tensor, Sensor, float, int, range, float], Tensor]


def restore(
    codes: Array,
    sensor: Sensor,
    exposure: float,
    *,
    method: str,
    device: torch.device,
    window: int,
    memory: float = np.inf,
    frames: range | None = None,
) -> Array:
    """Restore codes [T, H, W] by a method of METHODS on a device: photons, float32 [T, H, W].

    About `memory` bytes are taken there, those of one frame at least. `ValueError` as of the method on a CPU.
    """
    codes = checked_codes(codes, sensor)
    check_window(window)
    frames = range(len(codes)) if frames is None else frames
    there = path_merge.as_codes(codes, device)
    with torch.inference_mode():
        found = METHODS[method](there, sensor, exposure, window, frames, memory)
    return np.asarray(found.cpu())


# ---- Sums of a window


def _by_sums(
    table_of: Callable[[Sensor, float, int, torch.device], Tensor],
    codes: Tensor,
    sensor: Sensor,
    exposure: float,
    window: int,
    frames: range,
    memory: float,
) -> Tensor:
    """Restore by the sum of the existing codes of a window, whose photons a table of `table_of` has."""
    totals = _running_sums(codes)
    found = codes.new_empty((len(frames), *codes.shape[1:]), dtype=torch.float32)
    for part, before, count in equal_windows(frames, window, len(codes), len(frames)):
        first = part.start - before
        high = totals.narrow(0, first + count, len(part))
        sums = high - totals.narrow(0, first, len(part))
        table = table_of(sensor, exposure, count, codes.device)
        place = slice(part.start - frames.start, part.stop - frames.start)
        found[place] = table.index_select(0, sums.flatten()).view(sums.shape)
    return found


def _running_sums(codes: Tensor) -> Tensor:
    """Return the sums of the first 0, 1, ... T codes [T, H, W], int32 [T + 1, H, W]."""
    sums = codes.new_zeros((len(codes) + 1, *codes.shape[1:]), dtype=torch.int32)
    torch.cumsum(codes, 0, dtype=torch.int32, out=sums[1:])
    return sums


@lru_cache(maxsize=64)
def _naive_table(sensor: Sensor, exposure: float, count: int, device: torch.device) -> Tensor:
    return torch.tensor(naive_mean.photons_of_sums(sensor, exposure, count), dtype=torch.float32).to(device)


@lru_cache(maxsize=64)
def _moment_table(sensor: Sensor, exposure: float, count: int, device: torch.device) -> Tensor:
    table = few_codes.of_sums(sensor, exposure, ((1.0, count),))
    return torch.tensor(table, dtype=torch.float32).to(device)


def _moment(codes: Tensor, sensor: Sensor, exposure: float, window: int, frames: range, memory: float) -> Tensor:
    """Restore by the moment inverse."""
    sensor.response(exposure).cap(window)
    return _by_sums(_moment_table, codes, sensor, exposure, window, frames, memory)


def _likelihood(codes: Tensor, sensor: Sensor, exposure: float, window: int, frames: range, memory: float) -> Tensor:
    """Restore by maximum likelihood."""
    if few_codes.counts_suffice(sensor):
        return _moment(codes, sensor, exposure, window, frames, memory)
    sensor.response(exposure).cap(window)
    found = codes.new_empty((len(frames), *codes.shape[1:]), dtype=torch.float32)
    for part, _, _, seen in _windows(codes, window, frames, len(frames)):
        light = batched_likelihood.light_of_windows(seen, sensor, exposure, memory)
        found[part.start - frames.start : part.stop - frames.start] = light
    return found


# ---- BM3D and QBP


def _transform_denoise(
    kind: Kind, codes: Tensor, sensor: Sensor, exposure: float, window: int, frames: range, memory: float
) -> Tensor:
    """Restore by Transform Denoise."""
    length = len(codes)
    found = codes.new_empty((len(frames), *codes.shape[1:]), dtype=torch.float32)
    together = _together(memory, bm3d.PIXEL_BYTES, codes)
    for part, times in _reflected(length, window, frames, together):
        transform = tables.stabiliser(sensor, exposure, times, kind, codes.device)
        sums = codes.new_zeros((len(part), *codes.shape[1:]), dtype=torch.int32)
        for step in range(-(window // 2), look_ahead(window) + 1):
            seen = sliding_window.reflect(np.array(part) + step, length).tolist()
            sums += torch.stack([codes[t] for t in seen])
        stable = transform.forward(sums.to(torch.float64) / window)
        clean = bm3d.denoise(stable, transform.deviation, peak=transform.peak, memory=memory / 2)
        found[part.start - frames.start : part.stop - frames.start] = transform.inverse(clean)
    return found


def _qbp(
    settings: qbp.Settings,
    excess: float | None,
    codes: Tensor,
    sensor: Sensor,
    exposure: float,
    window: int,
    frames: range,
    memory: float,
) -> Tensor:
    """Restore by Quanta Burst Photography; with `excess` BM3D follows."""
    found = codes.new_empty((len(frames), *codes.shape[1:]), dtype=torch.float32)
    together = _together(memory, batched_qbp.PIXEL_BYTES, codes)
    for part, before, count, seen in _windows(codes, window, frames, together):
        start = before - window // 2
        merged = batched_qbp.merge(seen, range(start, start + window), sensor, exposure, settings)
        place = slice(part.start - frames.start, part.stop - frames.start)
        if excess is None:
            sensor.response(exposure).cap(count)
            found[place] = tables.light(sensor, exposure, codes.device)(merged, count)
            continue
        transform = tables.stabiliser(sensor, exposure, (1,) * count, "table", codes.device)
        stable = transform.forward(merged)
        clean = bm3d.denoise(stable, excess * transform.deviation, peak=transform.peak, memory=memory / 2)
        found[place] = transform.inverse(clean)
    return found


def _path_merge(codes: Tensor, sensor: Sensor, exposure: float, window: int, frames: range, memory: float) -> Tensor:
    """Restore by merging along paths."""
    length, height, width = codes.shape
    found = codes.new_empty((len(frames), height, width), dtype=torch.float32)
    domain = information_domain(sensor, exposure)
    light = tables.light(sensor, exposure, codes.device)
    together = _together(memory, path_merge.PIXEL_BYTES, codes)
    first = 0
    for merged in path_merge.stream(
        lambda t: codes[t], length, domain, window, frames, codes.device, together=together
    ):
        pixels = (merged.mean_code, path_merge.frames_of_light(merged, light.response))
        mean_code, count = (x[:, :height, :width] for x in pixels)
        found[first : first + len(mean_code)] = light(mean_code, count)
        first += len(mean_code)
    return found


# ---- Frames that are restored together


def _together(memory: float, pixel_bytes: int, codes: Tensor) -> int:
    """Return how many frames half of `memory` holds, one at least."""
    return max(1, int(min(memory / 2, 1e15) // (pixel_bytes * codes[0].numel())))


def _reflected(length: int, window: int, frames: range, most: int) -> Iterator[tuple[range, tuple[int, ...]]]:
    """Yield successive frames whose reflected windows take frames equally often, at most `most`, and how often."""
    times = [sliding_window.frame_times(frame, window, length) for frame in frames]
    for part in sliding_window.alike(times, frames, most):
        yield part, times[part.start - frames.start]


def _windows(codes: Tensor, window: int, frames: range, most: int) -> Iterator[tuple[range, int, int, Tensor]]:
    """Yield what `equal_windows` does, and the windows of codes [B, K, H, W] of these frames."""
    for part, before, count in equal_windows(frames, window, len(codes), most):
        first = part.start - before
        seen = codes[first : first + len(part) - 1 + count].unfold(0, count, 1).movedim(-1, 1)
        yield part, before, count, seen


METHODS: dict[str, Restore] = {
    "naive": partial(_by_sums, _naive_table),
    "moment": _moment,
    "likelihood": _likelihood,
    "transform-denoise": partial(_transform_denoise, "table"),
    "qbp": partial(_qbp, qbp.CALIBRATED, None),
    "qbp-bm3d": partial(_qbp, qbp.CALIBRATED, qbp.EXCESS),
    "path-merge": _path_merge,
    "transform-denoise-published": partial(_transform_denoise, "binomial"),
    "qbp-published": partial(_qbp, qbp.AS_PUBLISHED, None),
}
