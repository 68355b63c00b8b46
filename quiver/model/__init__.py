"""Defines the networks, pure functions of codes, and their weights files."""

from typing import TYPE_CHECKING

from qsim.lazy_imports import lazy_names

if TYPE_CHECKING:
    from quiver.model.config import Config
    from quiver.model.published_weights import from_published
    from quiver.model.quiver import QUIVER
    from quiver.model.unet import UNet, UNetConfig

_HOMES = {
    "QUIVER": "quiver",
    "Config": "config",
    "UNet": "unet",
    "UNetConfig": "unet",
    "from_published": "published_weights",
}

__all__ = ["QUIVER", "Config", "UNet", "UNetConfig", "from_published"]

__getattr__ = lazy_names(__name__, _HOMES)
