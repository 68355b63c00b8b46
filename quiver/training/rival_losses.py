"""Computes the losses of the compared networks, and the frame of a window that their published programs score.

Each is the loss of the network's published program on 3-bit frames; what is our reading is stated. All are computed in
float32, also under autocast. Weights files and frames are in units of white.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as functional
from torch import Tensor, nn

from quiver.data.codes import Codes
from quiver.data.noise_table import noise_table
from quiver.model.blocks import RADIUS, WINDOW, resize
from quiver.model.deformable import warp
from quiver.model.rivals.noise import table_of
from quiver.model.rivals.spk2imgnet import BEFORE, CONVERTER, GROUPS
from quiver.model.rivals.student_teacher import distillation_loss
from quiver.training.settings import Settings
from quiver.training.system import Batch

EPSILON = 1e-3  # of the Charbonnier loss, in units of white
ESTIMATES = 0.02  # weight of Spk2ImgNet's light estimates
PHOTOMETRIC = 0.05  # ours: weight of FloRNN's flow loss, beside squared errors of one frame
HALF = 0.5  # sums of squares are divided by twice their number


def charbonnier(a: Tensor, b: Tensor) -> Tensor:
    """Return the mean of sqrt((a - b)^2 + eps^2), a scalar."""
    return ((a.float() - b.float()).square() + EPSILON**2).sqrt().mean()


def every_frame(network: nn.Module, batch: Batch) -> tuple[Tensor, int]:
    """Return all restored frames of a window [B, T, 1, h, w], and 0."""
    return network(batch["codes"]), 0


def centre_frame(network: nn.Module, batch: Batch) -> tuple[Tensor, int]:
    """Return the middle frame of a window [B, 1, 1, h, w], and its place: 5 of the published eleven or twelve."""
    middle = (batch["codes"].shape[1] - 1) // 2
    return network(batch["codes"])[:, middle : middle + 1], middle


def windows_restored(network: Any, batch: Batch) -> tuple[Tensor, int]:
    """Return the frames whose window lies in that of the batch [B, n, 1, h, w], and the place of the first."""
    return network.windows(batch["codes"]), network.frames_in - 1 - network.look_ahead


# Networks that take the noise of the sensor


def noise_inputs(codes: Codes, sample: int) -> dict[str, Tensor]:
    """Return the noise table of a window's sensor [n], as `variance`."""
    return {"variance": torch.tensor(noise_table(codes.sensor, codes.exposure))}


# EMVD


def emvd_restored(network: nn.Module, batch: Batch) -> tuple[Tensor, int]:
    """Return the last frame of a window [B, 1, 1, h, w], and its place."""
    restored = network(batch["codes"], batch.get("variance"))
    return restored[:, -1:], restored.shape[1] - 1


def emvd_loss(network: Any, batch: Batch, settings: Settings, share: float) -> Tensor:
    """Return the mean L1 of the four channels of all frames, plus the distance of both transforms from inverses.

    The published program multiplies the wavelet taps without transposing; as published, so do we.
    """
    table = table_of(batch.get("variance"), batch["codes"])
    state = None
    restored = []
    for image in network.packed(batch["codes"]).unbind(1):
        output, state = network.step(state, image, table)
        restored.append(output)
    error = (torch.stack(restored, dim=1).float() - network.packed(batch["target"])).abs().mean()
    colour, back = (mix.net1.weight.flatten(1) for mix in (network.ct, network.cti))
    taps = network.ft.net1["weight"].view(2, 2)
    inverse = torch.stack([network.fti.net1["weight"].flatten(), network.fti.net2["weight"].flatten()])
    with torch.autocast(error.device.type, enabled=False):
        # Perfect reconstruction: analysis times synthesis is the identity.
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
    codes = batch["codes"]
    target = batch["target"]
    flows = network.flows(codes)
    images = codes.expand(-1, -1, network.config.image_channels, -1, -1)
    restored = network.restore(images, network.noise(codes, batch.get("variance")), flows).float()
    first = 1 if network.config.as_published else 0
    wanted = target[:, first : restored.shape[1]]
    squares = HALF * (restored[:, first:] - wanted).square().sum() / len(codes)
    if network.flow is None:
        return squares
    earlier = target[:, :-1].flatten(0, 1)
    later = target[:, 1:].flatten(0, 1)
    moved = warp(later, flows.forward.flatten(0, 1).float(), "border")
    back = warp(earlier, flows.backward.flatten(0, 1).float(), "border")
    photometric = (moved - earlier).abs().mean() + (back - later).abs().mean()
    # Squares are summed over frames and pixels; the mean photometric error is brought to that size.
    return squares + PHOTOMETRIC * restored.shape[1] * photometric * codes.shape[-2] * codes.shape[-1]


def flornn_restored(network: Any, batch: Batch) -> tuple[Tensor, int]:
    """Return the last frame of a window that needs no reflected frame [B, 1, 1, h, w], and its place."""
    codes = batch["codes"]
    images = codes.expand(-1, -1, network.config.image_channels, -1, -1)
    restored = network.restore(images, network.noise(codes, batch.get("variance")), network.flows(codes))
    return restored[:, -1:].mean(dim=2, keepdim=True), restored.shape[1] - 1


def check_flornn(network: Any, settings: Settings) -> None:
    """Raise `ValueError` for windows without a frame whose look-ahead lies inside, or without a flow network."""
    least = network.look_ahead + (2 if network.config.as_published else 1)
    if settings.frames < least:
        raise ValueError(
            f"frames={settings.frames}: with a look-ahead of {network.look_ahead} frames FloRNN needs {least}"
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


FEWEST = 4  # windows of small crops that MemDeblur's batch normalisation learns from


def check_memdeblur(network: Any, settings: Settings) -> None:
    """Raise `ValueError` for few small crops, of which batch normalisation sees few values per channel.

    With two of 32 to 64 px, or three of 32 px, the first gradient was not finite; with four it was.
    """
    if settings.together < FEWEST and settings.crop <= 64 and not network.config.group_norm:
        raise ValueError(
            f"batch={settings.together} with crop={settings.crop}: batch normalisation of MemDeblur needs {FEWEST} "
            f"windows at once or crops above 64 px; give batch={FEWEST}"
        )


# Student-Teacher

TEACHING = 0.3  # share of a run for each teacher


def student_begins(network: Any, settings: Settings) -> float:
    """Return the share of a run after which the student learns: at once without teachers."""
    return 2 * TEACHING if network.config.distil else 0.0


def check_student_teacher(network: nn.Module, settings: Settings) -> None:
    """Raise `ValueError` for windows of more frames than teachers and student see."""
    if settings.frames != WINDOW:
        raise ValueError(f"frames={settings.frames}: student-teacher learns from {WINDOW} frames; leave frames= out")


def student_teacher_loss(network: Any, batch: Batch, settings: Settings, share: float) -> Tensor:
    """Return the loss of the part that learns now: motion teacher, noise teacher, then the student.

    The motion teacher sees the sharp frames, the noise teacher noisy copies of the centre frame. Without teachers the
    student learns all the time.
    """
    first = batch["codes"].shape[1] // 2 - RADIUS  # `still` rests as in the middle frame of the window
    part = slice(first, first + WINDOW)
    sharp = batch["target"][:, part, 0]
    centre = sharp[:, RADIUS : RADIUS + 1]
    teachers = (network.motion_teacher, sharp), (network.noise_teacher, batch["still"][:, :WINDOW, 0])
    if share < student_begins(network, settings):
        teacher, seen = teachers[share >= TEACHING]
        return functional.mse_loss(teacher(seen).restored.float(), centre)
    taught = network.student(batch["codes"][:, part, 0])
    if not network.config.distil:
        return functional.mse_loss(taught.restored.float(), centre)
    with torch.no_grad():
        motion, noise = (teacher(seen).features[0] for teacher, seen in teachers)
    return distillation_loss(taught, centre, motion, noise)


# FastDVDnet


def fastdvdnet_restored(network: Any, batch: Batch) -> tuple[Tensor, int]:
    """Return the frames whose window lies in that of the batch [B, T-4, 1, h, w], and 2."""
    return network.windows(batch["codes"], batch.get("variance")), network.look_ahead


def fastdvdnet_loss(network: Any, batch: Batch, settings: Settings, share: float) -> Tensor:
    """Return the squared error of the restored frames, summed, over twice their number."""
    restored, first = fastdvdnet_restored(network, batch)
    wanted = batch["target"][:, first : first + restored.shape[1]]
    squares = (restored.float() - wanted).square().sum()
    return HALF * squares / (restored.shape[0] * restored.shape[1])


# RVRT


def charbonnier_loss(network: nn.Module, batch: Batch, settings: Settings, share: float) -> Tensor:
    """Return the Charbonnier loss of all frames of a window."""
    return charbonnier(network(batch["codes"]), batch["target"])


# Spk2ImgNet


def spk2imgnet_loss(network: Any, batch: Batch, settings: Settings, share: float) -> Tensor:
    """Return the L1 of the restored frames, plus 0.02 times the summed L1 of the light estimates.

    A window with more frames than the network takes gives one restored frame for each place.
    """
    factor = CONVERTER if network.config.as_published else 1.0
    codes = batch["codes"][:, :, 0]
    target = batch["target"][:, :, 0]
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
