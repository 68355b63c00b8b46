"""Lists the systems that can be trained: the network of each, with its loss, its window and its protocols."""

from __future__ import annotations

from typing import Any, Unpack

import torch
from torch import Tensor, nn

from quiver.model.blocks import RADIUS, Output
from quiver.model.mergenet import MergeNet
from quiver.model.mosaic_network import MosaicNet
from quiver.model.presets import build
from quiver.model.rivals.bit2bit import Bit2Bit
from quiver.model.rivals.emvd import EMVD
from quiver.model.rivals.fastdvdnet import FastDVDnet
from quiver.model.rivals.flornn import FloRNN
from quiver.model.rivals.memdeblur import MemDeblur
from quiver.model.rivals.rvrt import RVRT
from quiver.model.rivals.spk2imgnet import Spk2ImgNet
from quiver.model.rivals.student_teacher import StudentTeacher
from quiver.model.unet import UNet
from quiver.training import merge_training as merging
from quiver.training import rival_losses as rivals
from quiver.training.loss import PRESETS as LOSSES
from quiver.training.loss import parts_loss, training_loss, without_flow
from quiver.training.mosaic_training import mosaic_system
from quiver.training.self_supervised import split_loss
from quiver.training.settings import PROTOCOLS, Protocol, Settings
from quiver.training.system import Batch, System

# The published program trains all networks alike: these settings, unless a network states others.
_PORT: Protocol = {
    "sensor": "quiver-published",
    "ppp": (3.25,),
    "bits": (3,),
    "force_exposure": True,
    "reverse": False,
    "learning_rate": 1e-4,
    "schedule": "plateau",
    "warmup": 0,
    "crop": 128,
    "batch": 4,
    "steps": 63_000,
    "loss": "own",
    "precision": "float32",
}
_FASTDVDNET: Protocol = {
    "sensor": "quiver-published",
    "ppp": (3.25,),
    "bits": (3,),
    "force_exposure": True,
    "reverse": False,
    "schedule": "plateau",
    "warmup": 0,
    "crop": 96,
    "batch": 64,
    "steps": 320_000,
    "precision": "float32",
}
_STREAM: Protocol = {"frames": 32, "batch": 1, "learning_rate": 2e-4, "clip_norm": 1.0, "loss": "own"}
_QUICK: Protocol = {"learning_rate": 1e-3, "loss": "own"}


def _protocols(published: Protocol, **quick: Unpack[Protocol]) -> dict[str, Protocol]:
    """Return the protocols of a compared network: our short runs, and the published program."""
    short: Protocol = {**_QUICK, **quick}
    if "frames" in published:
        short.setdefault("frames", published["frames"])  # what a network is shown at once belongs to its design
    return {"quick": short, "published": {**_PORT, **published}}


# ---- Networks with the outside of QUIVER, and the control


def quiver_loss(network: Any, batch: Batch, settings: Settings, share: float) -> Tensor:
    """Return the loss of loss.py that the settings name, first of the pre-denoiser and the flow alone if they ask."""
    if share < settings.pretraining:
        denoised, flows = network.parts(batch["codes"])
        return parts_loss(denoised, flows, batch["target"], LOSSES[settings.loss])
    return training_loss(network(batch["codes"]), batch["target"], LOSSES[settings.loss], first=RADIUS)


def quiver_begins(network: Any, settings: Settings) -> float:
    """Return the share of a run after which the complete network learns."""
    return settings.pretraining


def check_quiver(network: Any, settings: Settings) -> None:
    """Raise `ValueError` for settings of parts that a network lacks."""
    if settings.pretraining and not (network.config.pre_denoiser or network.config.flow):
        raise ValueError("pretraining: this network has neither pre-denoiser nor flow; leave it out")
    if LOSSES[settings.loss].alignment and not network.config.flow:
        raise ValueError(f"loss={settings.loss}: is one of the flow, which this network lacks; choose another")


def quiver_restored(network: nn.Module, batch: Batch) -> tuple[Tensor, int]:
    """Return the restored frames 5 ... T-6 of a window [B, T-10, 1, h, w], and 5."""
    return network(batch["codes"]).scale1, RADIUS


def unet_loss(network: nn.Module, batch: Batch, settings: Settings, share: float) -> Tensor:
    """Return the loss of loss.py that the settings name, of the frames whose window lies in that of the batch."""
    restored, first = rivals.windows_restored(network, batch)
    output = Output(None, restored, None, None)  # scale 1 has its weight in the loss
    return training_loss(output, batch["target"], LOSSES[settings.loss], first=first)


OURS = System(
    "quiver",
    quiver_loss,
    quiver_restored,
    PROTOCOLS,
    losses=tuple(LOSSES),
    begins=quiver_begins,
    pretrains=True,
    check=check_quiver,
)

SYSTEMS: dict[type[nn.Module], System] = {
    MergeNet: System(
        name="mergenet",
        loss=merging.loss,
        restored=merging.restored,
        protocols=merging.PROTOCOLS,
        multiple=8,
        prepare=merging.prepare,
        prepare_batch=merging.prepare_batch,
        check=merging.check,
    ),
    UNet: System("unet", unet_loss, rivals.windows_restored, PROTOCOLS, losses=without_flow(LOSSES)),
    EMVD: System(
        name="emvd",
        loss=rivals.emvd_loss,
        restored=rivals.emvd_restored,
        protocols=_protocols({"clip_norm": 5.0}, clip_norm=5.0),
        as_long=True,
        prepare=rivals.noise_inputs,
    ),
    FloRNN: System(
        name="flornn",
        loss=rivals.flornn_loss,
        restored=rivals.flornn_restored,
        # The published eleven frames train the forward state over one step: on whole clips it can grow without end.
        protocols=_protocols({}, learning_rate=3e-4, frames=20),
        as_long=True,
        prepare=rivals.noise_inputs,
        check=rivals.check_flornn,
    ),
    MemDeblur: System(
        name="memdeblur",
        loss=rivals.memdeblur_loss,
        restored=rivals.centre_frame,
        protocols=_protocols({}, crop=128),  # less has keys of 1 px
        as_long=True,
        multiple=16,
        check=rivals.check_memdeblur,
    ),
    FastDVDnet: System(
        name="fastdvdnet",
        loss=rivals.fastdvdnet_loss,
        restored=rivals.fastdvdnet_restored,
        protocols=_protocols(_FASTDVDNET | {"learning_rate": 1e-3, "frames": 5}),
        multiple=4,
        prepare=rivals.noise_inputs,
    ),
    StudentTeacher: System(
        name="student-teacher",
        loss=rivals.student_teacher_loss,
        restored=rivals.windows_restored,
        protocols=_protocols({}, learning_rate=3e-4),
        still=True,
        begins=rivals.student_begins,
        check=rivals.check_student_teacher,
    ),
    Bit2Bit: System(
        name="bit2bit",
        loss=split_loss,
        restored=rivals.every_frame,
        protocols={"quick": _STREAM | {"crop": 64}, "published": _STREAM | {"crop": 256, "precision": "float32"}},
        frames=1,
        of_stream=True,
    ),
    RVRT: System(
        name="rvrt",
        loss=rivals.charbonnier_loss,
        restored=rivals.centre_frame,
        # 64 px would be padded to 132, and three quarters of the pixels would repeat the border.
        protocols=_protocols({"crop": 240, "batch": 2, "steps": 125_000, "frames": 12}, learning_rate=3e-4, crop=128),
        frames=12,
        as_long=True,
    ),
    Spk2ImgNet: System(
        name="spk2imgnet",
        loss=rivals.spk2imgnet_loss,
        restored=rivals.spk2imgnet_restored,
        protocols=_protocols({"frames": 10}, learning_rate=3e-4),
        multiple=4,
    ),
}


def system_of(network: nn.Module) -> System:
    """Return how a network is trained; networks with the outside of QUIVER are trained alike."""
    if isinstance(network, MosaicNet):
        return mosaic_system(system_of(network.core), network)
    return SYSTEMS.get(type(network), OURS)


def system_named(preset: str) -> System:
    """Return how the network of a preset is trained; ValueError for an unknown name."""
    with torch.device("meta"):
        return system_of(build(preset))
