"""Describes what the loop must know of a network beside its weights: its window, inputs, loss and settings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.data import default_collate

from quiver.data.device_filling import FILL
from quiver.data.sensor_of_window import SENSORS, TOP, SeenBy, seen_by
from quiver.data.windows import Prepare
from quiver.device import is_gpu
from quiver.training.settings import Protocol, Settings

Batch = Mapping[str, Any]  # of samples from `Windows`: codes and target [B, T, 1, h, w], and what `prepare` adds

# (network, batch, settings, share of the run that is over, 0 ... 1) -> a scalar
Loss = Callable[[nn.Module, Batch, Settings, float], Tensor]

# (network, batch) -> restored frames [B, n, 1, h, w] in units of white, and the place of the first in the window
Restored = Callable[[nn.Module, Batch], tuple[Tensor, int]]


# Inputs of a batch on its device: (codes [B, T, h, w] in whole numbers, the sensor of each window) -> name -> tensor
PrepareBatch = Callable[[Tensor, Sequence[SeenBy]], Mapping[str, Tensor]]


def collated(samples: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return a batch of samples; their sensors and fills stay lists."""
    lists = [name for name in (SENSORS, FILL) if name in samples[0]]
    batch = default_collate([{name: value for name, value in one.items() if name not in lists} for one in samples])
    return batch | {name: [one[name] for one in samples] for name in lists}


def nothing_to_refuse(network: nn.Module, settings: Settings) -> None:
    """Accept all settings."""


def at_once(network: nn.Module, settings: Settings) -> float:
    """Return 0: the network learns from the first step on."""
    return 0.0


@dataclass(frozen=True)
class System:
    """How networks of one kind are trained: functions without state, and numbers."""

    name: str  # for messages
    loss: Loss
    restored: Restored  # what a validation scores
    protocols: Mapping[str, Protocol]  # name -> settings that options override
    losses: tuple[str, ...] = ("own",)  # values of Settings.loss that `loss` accepts
    frames: int = 11  # of the windows of a validation, and least of those of training
    as_long: bool = False  # validations see as many frames as training: a state that grows over them is told
    multiple: int | None = None  # px that divides the side of a crop; None: the network's own `multiple`, else 1
    prepare: Prepare | None = None  # computes more inputs where samples are drawn
    prepare_batch: PrepareBatch | None = None  # computes the same inputs of a batch on a device
    still: bool = False  # samples also hold noisy copies of the centre frame
    of_stream: bool = False  # learns from the frames of one stored stream, without truth or validation
    # (network, settings) -> share of a run after which the scored part learns
    begins: Callable[[nn.Module, Settings], float] = at_once
    pretrains: bool = False  # some parts can learn alone for the first `pretraining` of a run
    check: Callable[[nn.Module, Settings], None] = nothing_to_refuse  # ValueError for settings that do not fit

    def on(self, device: torch.device, windows: str = "auto") -> System:
        """Return how the network is trained on a device: on a GPU inputs are made there, of a complete batch.

        On a CPU they are made where samples are drawn, and `prepare_batch` is None, unless `windows` are drawn on the
        "device".
        """
        if self.prepare_batch is None or not (is_gpu(device) or windows == "device"):
            return replace(self, prepare_batch=None)
        return replace(self, prepare=seen_by)

    def with_inputs(self, batch: Batch) -> Batch:
        """Return a batch on its device with the inputs that are made there."""
        if self.prepare_batch is None:
            return batch
        codes = (batch["codes"][:, :, 0] * batch[TOP][:, None, None, None]).round_()
        own = {name: value for name, value in batch.items() if name not in (SENSORS, TOP)}
        return own | dict(self.prepare_batch(codes, batch[SENSORS]))

    def window(self, network: nn.Module) -> int:
        """Return the least number of frames of a window: the network's own `frames_in`, if it has one."""
        return int(getattr(network, "frames_in", self.frames))

    def validated(self, network: nn.Module, settings: Settings) -> int:
        """Return the frames of the windows of a validation."""
        return settings.frames if self.as_long else self.window(network)

    def side(self, network: nn.Module) -> int:
        """Return the number of px that must divide the side of a crop."""
        return int(getattr(network, "multiple", 1)) if self.multiple is None else self.multiple

    def refuse(self, network: nn.Module, settings: Settings) -> None:
        """Raise `ValueError` for settings with which the network cannot be trained."""
        least = self.window(network)
        multiple = self.side(network)
        if settings.frames < least:
            raise ValueError(f"frames= must be at least {least}, the window of {self.name}, got {settings.frames}")
        if settings.crop % multiple:
            raise ValueError(f"crop={settings.crop}: this network needs a multiple of {multiple}")
        if settings.loss not in self.losses:
            raise ValueError(
                f"loss={settings.loss}: {self.name} is trained with {' or '.join(self.losses)}; leave loss= out"
            )
        if settings.pretraining and not self.pretrains:
            raise ValueError(
                f"pretraining={settings.pretraining:g}: {self.name} has no parts that learn alone; leave it out"
            )
        if self.of_stream and settings.schedule == "plateau":
            raise ValueError(f"schedule=plateau: follows validations, and {self.name} has none; leave it out")
        if settings.schedule == "plateau" and settings.steps is None:
            raise ValueError(
                "schedule=plateau: a run that minutes= ends has ten validations, too few for it; give "
                "steps=, or leave it out"
            )
        self.check(network, settings)


class Objective(nn.Module):
    """A network with its loss: one module, so that processes share the gradients of all that the loss computes."""

    def __init__(self, network: nn.Module, loss: Loss, settings: Settings) -> None:
        super().__init__()
        self.network = network
        self.loss = loss
        self.settings = settings
        self._compiled: list[Any] = []  # in a list, as torch would count its weights again

    def use_compiled(self, network: Any | None) -> None:
        """Compute with this form of the network, which shares its weights; None: with the network itself."""
        self._compiled = [] if network is None else [network]

    def forward(self, batch: Batch, share: float) -> Tensor:
        """Return the loss of a batch, a scalar; `share` of the run is over."""
        network = self._compiled[0] if self._compiled else self.network
        return self.loss(network, batch, self.settings, share)


def protocol(system: System, name: str) -> Protocol:
    """Return the settings of a protocol; `ValueError` if the system has none of that name."""
    if name not in system.protocols:
        raise ValueError(f"protocol={name}: {system.name} has {' and '.join(system.protocols)}; choose one of them")
    return system.protocols[name]
