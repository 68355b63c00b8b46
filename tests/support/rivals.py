"""Makes small networks of all rivals and of the U-Net for tests: float64, evaluation mode, every stage contributes."""

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import torch
from golden import fill_by_rule
from torch import nn

from quiver.model.rivals.bit2bit import Bit2Bit, Bit2BitConfig
from quiver.model.rivals.fastdvdnet import FastDVDnet, FastDVDnetConfig
from quiver.model.rivals.student_teacher import StudentTeacher, StudentTeacherConfig
from quiver.model.unet import UNet, UNetConfig

N = TypeVar("N", bound=nn.Module)
GOLDEN = [importlib.import_module(path.stem) for path in sorted(Path(__file__).parent.glob("golden_*.py"))]


def lively(network: N) -> N:
    """Fill a network by rule, its normalisation with factors near 1."""
    fill_by_rule(network)
    generator = torch.Generator().manual_seed(4)
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d | nn.GroupNorm):
            module.weight.data.uniform_(0.5, 1.5, generator=generator)
        if isinstance(module, nn.BatchNorm2d):
            module.running_mean.uniform_(-0.2, 0.2, generator=generator)
            module.running_var.uniform_(0.5, 1.5, generator=generator)
    return network.double().eval()


SMALL: dict[str, Callable[[], nn.Module]] = {
    **{module.__name__.removeprefix("golden_"): module.small for module in GOLDEN if hasattr(module, "small")},
    "bit2bit": lambda: lively(Bit2Bit(Bit2BitConfig(width=4))),
    "bit2bit_as_published": lambda: lively(Bit2Bit(Bit2BitConfig(width=4, as_published=True))),
    "student_teacher": lambda: lively(StudentTeacher(StudentTeacherConfig(width=3, blocks=1))),
    "unet": lambda: lively(UNet(UNetConfig(2))),
    "fastdvdnet": lambda: lively(FastDVDnet(FastDVDnetConfig(width=4))),
}
