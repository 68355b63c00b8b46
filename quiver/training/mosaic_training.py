"""States how a network learns from mosaics: places are windows of one band, the loss is that of the three bands.

    codes of a mosaic -> codes of each place -> core -> light of the mosaic -> linear estimate -> MosaicNet.bands

Gradients reach the core through the linear estimate. The loss is the logarithm of the mean squared error of the bands
over the peak, as that of MergeNet, or a loss of loss.py at full scale.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
import torch.nn.functional as functional
from torch import Tensor, nn

from quiver.data.codes import Codes
from quiver.data.mosaic_windows import within
from quiver.data.windows import Prepare
from quiver.model.mosaic_network import MosaicNet
from quiver.restoration.mosaics import places
from quiver.training.loss import PRESETS as LOSSES
from quiver.training.loss import training_loss, without_flow
from quiver.training.merge_training import log_error
from quiver.training.settings import Settings
from quiver.training.system import Batch, System

KERNELS = "demosaicing"  # of a sample: the filters of the linear estimate
OF_PLACE = "place."  # before the names of inputs that the core's system prepares, stacked over the places


def mosaic_system(core: System, network: MosaicNet) -> System:
    """Return how a network with a learned end is trained, whose core is trained by itself as stated.

    `ValueError` for cores that need more than the codes of a window: copies at rest, or a stream of their own.
    """
    if core.still or core.of_stream:
        raise ValueError(f"{core.name}: learns from other windows than a mosaic has; choose another network for colour")
    return replace(
        core,
        name=f"{core.name} on mosaics",
        loss=partial(loss, core),
        restored=partial(restored, core),
        frames=core.window(network.core),
        multiple=core.side(network.core) * math.lcm(*network.config.tile),
        prepare=partial(prepare, core.prepare),
        prepare_batch=None,
        losses=without_flow(core.losses),
        pretrains=False,
        check=partial(_check, core),
    )


def _check(core: System, network: Any, settings: Settings) -> None:
    core.check(network.core, settings)


def prepare(of_place: Prepare | None, codes: Codes, sample: int) -> dict[str, Tensor]:
    """Return the linear estimate's filters, and the inputs that the core needs of every place, stacked."""
    found = {KERNELS: torch.from_numpy(codes.demosaicing_filters.astype(np.float32))}
    if of_place is None:
        return found
    each = [of_place(place, sample) for _, place in places(codes)]
    return found | {f"{OF_PLACE}{name}": torch.stack([inputs[name] for inputs in each]) for name in each[0]}


def restored(core: System, network: MosaicNet, batch: Batch) -> tuple[Tensor, int]:
    """Return restored bands [B, n, 3, H, W] in units of white, and the place of the first frame in the window."""
    tile = network.config.tile
    count = tile[0] * tile[1]
    windows, length = batch["codes"].shape[:2]
    of_places = MosaicNet.split(batch["codes"].flatten(0, 1), tile)  # [B T, places, h, w]
    of_places = of_places.unflatten(0, (windows, length)).transpose(1, 2).flatten(0, 1)[:, :, None]
    inputs = _of_places(batch, count) | {"codes": of_places}
    light, first = core.restored(network.core, inputs)  # [B places, n, 1, h, w]
    light = light[:, :, 0].float().unflatten(0, (windows, count)).transpose(1, 2).flatten(0, 1)
    mosaic = MosaicNet.join(light, tile)[:, 0]  # [B n, H, W]
    frames = len(mosaic) // windows
    kernels = batch[KERNELS].repeat_interleave(frames, dim=0)
    linear = linear_bands(mosaic, kernels)
    mean = mosaic.mean((1, 2))
    photons = mean * batch["white"].to(mean.dtype).repeat_interleave(frames)
    bands = network.bands(mosaic, linear, mean, photons)
    return bands.unflatten(0, (windows, frames)), first


def _of_places(batch: Batch, count: int) -> dict[str, Any]:
    """Return a batch of windows of one band: what is stated of a mosaic holds for each of its `count` places."""
    found: dict[str, Any] = {}
    for name, value in batch.items():
        if name.startswith(OF_PLACE):
            found[name.removeprefix(OF_PLACE)] = value.flatten(0, 1)
        elif name in ("white", "peak", "ppp", "shares"):
            found[name] = value.repeat_interleave(count, dim=0)
    return found


def linear_bands(mosaic: Tensor, kernels: Tensor) -> Tensor:
    """Return R, G and B [N, 3, H, W] of mosaics [N, H, W] by the filters [N, rows, columns, 3, n, n], differentiable.

    It equals `qsim.sensor.demosaicing.demosaic` without a floor.
    """
    count, height, width = mosaic.shape
    rows, columns = kernels.shape[1:3]
    reach = kernels.shape[-1] // 2
    y = torch.from_numpy(within(height, rows, reach))
    x = torch.from_numpy(within(width, columns, reach))
    padded = mosaic[:, y.to(mosaic.device)[:, None], x.to(mosaic.device)][None]  # frames are groups of one convolution
    out = mosaic.new_empty(count, 3, height, width)
    for i, j in np.ndindex(rows, columns):
        filters = kernels[:, i, j].flatten(0, 1)[:, None].to(mosaic.dtype)
        found = functional.conv2d(padded[:, :, i:, j:], filters, stride=(rows, columns), groups=count)
        shape = len(range(i, height, rows)), len(range(j, width, columns))
        out[:, :, i::rows, j::columns] = found[0, :, : shape[0], : shape[1]].unflatten(0, (count, 3))
    return out


def loss(core: System, network: nn.Module, batch: Batch, settings: Settings, share: float) -> Tensor:
    """Return the loss of the bands: the one of loss.py that the settings name, else the log of their squared error."""
    assert isinstance(network, MosaicNet)
    bands, first = restored(core, network, batch)
    if settings.loss in LOSSES:
        frames = bands.flatten(1, 2)[:, :, None]  # every band of a frame is a picture
        target = batch["target"][:, first : first + bands.shape[1]].flatten(1, 2)[:, :, None]
        return training_loss(frames, target, LOSSES[settings.loss], first=0)
    unit = (batch["white"] / batch["peak"]).to(bands.dtype)[:, None, None, None, None]
    shown = (bands.float() * unit).flatten(0, 2)
    wanted = (batch["target"][:, first : first + bands.shape[1]] * unit).flatten(0, 2)
    return log_error(shown, wanted).mean()
