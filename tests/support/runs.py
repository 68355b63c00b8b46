"""Makes settings and networks for small training runs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from golden import TINY as NARROW
from torch import nn

from quiver.model.mergenet import MergeNet, MergeNetConfig
from quiver.model.quiver import QUIVER
from quiver.model.rivals.bit2bit import Bit2Bit, Bit2BitConfig
from quiver.model.rivals.emvd import EMVD, EMVDConfig
from quiver.model.rivals.fastdvdnet import FastDVDnet, FastDVDnetConfig
from quiver.model.rivals.flornn import FloRNN, FloRNNConfig
from quiver.model.rivals.memdeblur import MemDeblur, MemDeblurConfig
from quiver.model.rivals.rvrt import RVRT, RVRTConfig
from quiver.model.rivals.spk2imgnet import Spk2ImgNet, Spk2ImgNetConfig
from quiver.model.rivals.student_teacher import StudentTeacher, StudentTeacherConfig
from quiver.model.unet import UNet, UNetConfig
from quiver.training.settings import Settings
from quiver.training.systems import system_of


def settings(data: Path | tuple[Path, ...], out: Path, **changes: object) -> Settings:
    defaults = {"steps": 6, "crop": 16, "batch": 2, "validate_every": 4, "warmup": 2, "validation_windows": 2}
    folders = tuple(map(str, data)) if isinstance(data, tuple) else str(data)
    return Settings(folders, str(out), **defaults | changes)


def small_network(seed: int = 0) -> UNet:
    torch.manual_seed(seed)
    return UNet(UNetConfig(4))


def same_weights(a: nn.Module, b: nn.Module) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a.state_dict().values(), b.state_dict().values(), strict=True))


TINY: dict[str, Callable[[], nn.Module]] = {  # a small network of every system that is trained on clips
    "unet": lambda: UNet(UNetConfig(4)),
    "quiver": lambda: QUIVER(NARROW),
    "emvd": lambda: EMVD(EMVDConfig(width=4)),
    "fastdvdnet": lambda: FastDVDnet(FastDVDnetConfig(width=4)),
    "student-teacher": lambda: StudentTeacher(StudentTeacherConfig(width=4, blocks=1)),
    "flornn": lambda: FloRNN(FloRNNConfig(width=4, blocks=1, flow_channels=(2, 4, 2, 2), flow_kernel=3, flow_levels=3)),
    "memdeblur": lambda: MemDeblur(MemDeblurConfig(width=8, forward_blocks=1, backward_blocks=1)),
    "rvrt": lambda: RVRT(RVRTConfig(width=6, flow_levels=1)),
    "spk2imgnet": lambda: Spk2ImgNet(Spk2ImgNetConfig(width=8, blocks=1)),
    "mergenet": lambda: MergeNet(MergeNetConfig(4)),
}
EVERY = TINY | {"bit2bit": lambda: Bit2Bit(Bit2BitConfig(width=4))}  # and of the one that is trained on a stream


def tiny(name: str, seed: int = 0) -> nn.Module:
    """Return a small network of a system, with its random weights."""
    torch.manual_seed(seed)
    return EVERY[name]()


def tiny_settings(network: nn.Module, data: Path, out: Path, **changes: object) -> Settings:
    """Return the settings of a short run of a network, with its own window and loss."""
    system = system_of(network)
    own = {"frames": max(system.window(network), 11), "loss": system.losses[0]}
    return settings(data, out, **own | changes)
