"""Trains bit2bit on one stored stream: the law that its codes obey, and its loss.

stream -> configuration of the network; crops of its codes -> split at random into input and target -> loss
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from torch import Tensor

from quiver.data.codes import Codes
from quiver.data.stream_windows import StreamWindows, law_of, stream_at
from quiver.data.windows import WindowSettings
from quiver.model.rivals.bit2bit import Bit2BitConfig, bit2bit_loss
from quiver.training.settings import Settings
from quiver.training.system import Batch


def config_for(codes: Codes, sizes: Bit2BitConfig | None = None) -> Bit2BitConfig:
    """Return a configuration, by default the published one, with the law of a stream.

    `ValueError` for a QIS whose codes are no counts.
    """
    law = law_of(codes)
    top = codes.sensor.levels - 1
    return replace(sizes or Bit2BitConfig(), planes=top, dark=law.dark, as_published=not law.planes)


def own_light(settings: Settings, codes: Codes) -> Settings:
    """Return the settings with sensor, bits and light [photons/pixel] of the stream, for the weights file."""
    light = None if codes.ppp is None else (codes.ppp,)
    return replace(settings, sensor=codes.sensor_name or None, ppp=light, bits=(codes.sensor.bits,))


def make_stream_windows(settings: Settings) -> StreamWindows:
    """Return the windows of the stream that the settings name; errors as of `stream_at` and `StreamWindows`."""
    window = WindowSettings(
        frames=settings.frames, crop=settings.crop, flips=settings.flips, reverse=settings.reverse, seed=settings.seed
    )
    return StreamWindows(stream_at(Path(settings.folders[0]), settings.scan), window)


def split_loss(network: Any, batch: Batch, settings: Settings, share: float) -> Tensor:
    """Return the loss of one random split of the codes; the split is drawn by torch's generator."""
    return bit2bit_loss(network, (batch["codes"] * network.config.planes).round())
