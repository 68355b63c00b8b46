"""Computes the losses of the compared networks, and the frame of a window that their published programs score.

Each is the loss of the network's published program on 3-bit frames; what is our reading is stated. All are computed in
float32, also under autocast. Weights files and frames are in units of white.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from quiver.model.blocks import resize
from quiver.model.deformable import warp
from quiver.model.rivals.spk2imgnet import BEFORE, CONVERTER, GROUPS
from quiver.training.settings import Settings
from quiver.training.system import Batch

EPSILON = 1e-3  # of the Charbonnier loss, in units of white
ESTIMATES = 0.02  # weight of Spk2ImgNet's light estimates
PHOTOMETRIC = 0.1  # ours: weight of FloRNN's flow loss, beside squared errors
SQUARED_FRAMES = 0.5  # FloRNN: sums of squares are divided by twice the batch


def charbonnier(a: Tensor, b: Tensor) -> Tensor:
    """Return the mean of sqrt((a - b)^2 + eps^2), a scalar."""
    return ((a.float() - b.float()).square() + EPSILON**2).sqrt().mean()


def every_frame(network: nn.Module, batch: Batch) -> tuple[Tensor, int]:
    """Return all restored frames of a window [B, T, 1, h, w], and 0."""
    return network(batch["codes"]), 0


def centre_frame(network: nn.Module, batch: Batch) -> tuple[Tensor, int]:
    """Return frame 5 of a window [B, 1, 1, h, w], and 5."""
    return network(batch["codes"])[:, BEFORE : BEFORE + 1], BEFORE


def last_frame(network: nn.Module, batch: Batch) -> tuple[Tensor, int]:
    """Return the last frame of a window [B, 1, 1, h, w], and its place."""
    restored = network(batch["codes"])
    return restored[:, -1:], restored.shape[1] - 1


# EMVD


def emvd_loss(network: Any, batch: Batch, settings: Settings, share: float) -> Tensor:
    """Return the mean L1 of the four channels of all frames, plus the distance of both transforms from inverses.

    The published program multiplies the wavelet taps without transposing; as published, so do we.
    """
    state, restored = None, []
    for image in network.packed(batch["codes"]).unbind(1):
        output, state = network.step(state, image)
        restored.append(output)
    error = (torch.stack(restored, dim=1).float() - network.packed(batch["target"])).abs().mean()
    colour, back = (mix.net1.weight.flatten(1) for mix in (network.ct, network.cti))
    taps = network.ft.net1["weight"].view(2, 2)
    inverse = torch.stack([network.fti.net1["weight"].flatten(), network.fti.net2["weight"].flatten()])
    product = taps @ inverse if network.config.as_published else taps.T @ inverse
    return error + _from_identity(colour @ back) + _from_identity(product)


def _from_identity(product: Tensor) -> Tensor:
    return (product.float() - torch.eye(len(product), device=product.device)).square().sum()


# FloRNN


def flornn_loss(network: Any, batch: Batch, settings: Settings, share: float) -> Tensor:
    """Return the squared error of the frames whose look-ahead lies inside the window, summed, over twice the batch.

    The published program leaves frame 0 out; as published, so do we. Our flow network learns by a photometric L1 of
    the sharp frames beside: the published one was trained elsewhere.
    """
    codes, target = batch["codes"], batch["target"]
    flows = network.flows(codes)
    images = codes.expand(-1, -1, network.config.image_channels, -1, -1)
    restored = network.restore(images, network.noise(codes), flows).float()
    first = 1 if network.config.as_published else 0
    wanted = target[:, first : restored.shape[1]]
    squares = SQUARED_FRAMES * (restored[:, first:] - wanted).square().sum() / len(codes)
    if network.flow is None:
        return squares
    earlier, later = target[:, :-1].flatten(0, 1), target[:, 1:].flatten(0, 1)
    moved = warp(later, flows.forward.flatten(0, 1).float(), "border")
    back = warp(earlier, flows.backward.flatten(0, 1).float(), "border")
    photometric = (moved - earlier).abs().mean() + (back - later).abs().mean()
    return squares + PHOTOMETRIC * photometric * codes.shape[-2] * codes.shape[-1]


def flornn_restored(network: Any, batch: Batch) -> tuple[Tensor, int]:
    """Return the last frame of a window that needs no reflected frame [B, 1, 1, h, w], and its place."""
    codes = batch["codes"]
    images = codes.expand(-1, -1, network.config.image_channels, -1, -1)
    restored = network.restore(images, network.noise(codes), network.flows(codes))
    return restored[:, -1:].mean(dim=2, keepdim=True), restored.shape[1] - 1


def check_flornn(network: Any, settings: Settings) -> None:
    """Raise `ValueError` for windows without a frame whose look-ahead lies inside, or without a flow network."""
    least = network.look_ahead + (2 if network.config.as_published else 1)
    if settings.frames < least:
        raise ValueError(
            f"--frames {settings.frames}: with a look-ahead of {network.look_ahead} frames FloRNN needs {least}"
        )
    if network.flow is None:
        raise ValueError("this FloRNN has no flow network, and clips give none; set FloRNNConfig.flow_channels")


# MemDeblur


def memdeblur_loss(network: Any, batch: Batch, settings: Settings, share: float) -> Tensor:
    """Return the Charbonnier loss of all frames, summed over the three scales; targets are resized bilinearly."""
    target = batch["target"]
    total = target.new_zeros(())
    for restored in network.scales(network.images(batch["codes"])):
        total = total + charbonnier(restored + network.centre, resize(target, *restored.shape[-2:]))
    return total


def check_memdeblur(network: Any, settings: Settings) -> None:
    """Raise `ValueError` for a batch of one small crop, of which batch normalisation sees one value per channel."""
    if settings.batch == 1 and settings.crop <= 64 and not network.config.group_norm:
        raise ValueError(
            f"--batch 1 with --crop {settings.crop}: batch normalisation of MemDeblur needs two windows or crops above "
            "64 px; give --batch 2"
        )


# RVRT, and others that restore every frame


def charbonnier_loss(network: nn.Module, batch: Batch, settings: Settings, share: float) -> Tensor:
    """Return the Charbonnier loss of all frames of a window."""
    return charbonnier(network(batch["codes"]), batch["target"])


# Spk2ImgNet


def spk2imgnet_loss(network: Any, batch: Batch, settings: Settings, share: float) -> Tensor:
    """Return the L1 of the restored frames, plus 0.02 times the summed L1 of the light estimates.

    A window with more frames than the network takes gives one restored frame for each place.
    """
    factor = CONVERTER if network.config.as_published else 1.0
    codes, target = batch["codes"][:, :, 0], batch["target"][:, :, 0]
    places = range(codes.shape[1] - network.frames_in + 1)
    total = target.new_zeros(())
    for start in places:
        restored, estimates = network.window(codes[:, start : start + network.frames_in])
        wanted = target[:, start + BEFORE]
        total = total + (restored[:, 0].float() / factor - wanted).abs().mean()
        middles = target[:, [start + 2 * j + 1 for j in range(GROUPS)]][:, :, None]
        apart = (estimates.float() / factor - middles).abs().mean(dim=(0, 3, 4)).sum()
        total = total + ESTIMATES * apart
    return total / len(places)


def spk2imgnet_restored(network: Any, batch: Batch) -> tuple[Tensor, int]:
    """Return frame 5 of a window [B, 1, 1, h, w], and 5."""
    restored, _ = network.window(batch["codes"][:, : network.frames_in, 0])
    return restored[:, None], BEFORE
