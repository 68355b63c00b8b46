"""Lists the classical restorers: one signature for all.

    restore(codes [T, H, W], sensor, exposure, *, window=..., photons_per_unit=1, frames=None)
        -> restored [T, H, W], float32

With a range `frames`, only these are restored, also from the frames around them. Any number of frames and any size is
allowed; beyond its ends a clip is continued by reflection, but methods that follow motion take the frames that exist.
METHODS is the complete list; the module of a method has its other settings, and is imported when the method runs.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any

from numpy import ndarray as Array

from quiver.baselines.sliding_window import look_ahead
from quiver.host import own_numbers


@dataclass(frozen=True)
class Method:
    """A restorer and its entries in a table."""

    name: str
    home: str  # module:function in quiver.baselines
    window: int  # frames used for one restored frame, by default
    bytes_per_pixel: int  # working memory, about, beside the codes and the video
    description: str

    @own_numbers
    def restore(self, *given: Any, **settings: Any) -> Array:
        """Restore codes by the function of this method, which has the signature above."""
        module, _, function = self.home.partition(":")
        restored: Array = getattr(import_module(f"quiver.baselines.{module}"), function)(*given, **settings)
        return restored

    @property
    def look_ahead(self) -> int:
        """Return the future frames used for one restored frame, with the default window."""
        return look_ahead(self.window)


_LIST = (
    Method("naive", "naive_mean:restore", 11, 50, "mean of the codes, taken as linear in light"),
    Method("moment", "moment:restore", 11, 50, "mean of the codes through the exact inverse response"),
    Method("likelihood", "likelihood:restore", 11, 300, "most likely light given the codes of one pixel"),
    Method(
        "transform-denoise",
        "transform_denoise:restore",
        3,
        1800,
        "stabilise, BM3D by the noise of each frame, exact unbiased inverse",
    ),
    Method("qbp", "qbp:restore", 11, 600, "align, Wiener merge of the frames that exist, exact inverse response"),
    Method(
        "qbp-bm3d",
        "qbp:restore_denoised",
        11,
        1800,
        "align, Wiener merge of the frames that exist, stabilise, BM3D by their noise, exact unbiased inverse",
    ),
    Method(
        "path-merge",
        "path_merge:restore",
        11,
        500,
        "merge the frames that exist along smooth paths, exact inverse response",
    ),
    Method(
        "transform-denoise-published",
        "transform_denoise:restore_as_published",
        3,
        1800,
        "Transform Denoise with the arcsine for sums of binary samples, by the noise of each frame",
    ),
    Method(
        "qbp-published",
        "qbp:restore_as_published",
        11,
        600,
        "QBP of the frames that exist, with the article's noise estimate and whole-pixel shifts",
    ),
)
METHODS: dict[str, Method] = {method.name: method for method in _LIST}
