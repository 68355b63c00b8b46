"""Lists the classical restorers: one module per method, one signature.

    restore(codes [T, H, W], sensor, exposure, *, window=..., photons_per_unit=1, frames=None)
        -> restored [T, H, W], float32

With a range `frames`, only these are restored, also from the frames around them. Any number of frames and any size is
allowed; beyond its ends a clip is continued by reflection, but methods that follow motion take the frames that exist.
METHODS is the complete list; the module of a method has its
other settings. Path merge needs torch; QBP and BM3D use it where it is installed (arrays.py).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from numpy import ndarray as Array

from quiver.baselines import likelihood, moment, naive_mean
from quiver.baselines.sliding_window import look_ahead


@dataclass(frozen=True)
class Method:
    """A restorer and its entries in a table."""

    name: str
    restore: Callable[..., Array]  # restore(codes, sensor, exposure, *, window=..., photons_per_unit=1) -> [T, H, W]
    window: int  # frames used for one restored frame, by default
    description: str
    bytes_per_pixel: int  # working memory, about, beside the codes and the video

    @property
    def look_ahead(self) -> int:
        """Return the future frames used for one restored frame, with the default window."""
        return look_ahead(self.window)


def _transform_denoise(*given: Any, **settings: Any) -> Array:
    from quiver.baselines import transform_denoise

    return transform_denoise.restore(*given, **settings)


def _transform_denoise_published(*given: Any, **settings: Any) -> Array:
    return _transform_denoise(*given, kind="binomial", **settings)


def _qbp(*given: Any, **settings: Any) -> Array:
    from quiver.baselines import qbp

    return qbp.restore(*given, **settings)


def _qbp_bm3d(*given: Any, **settings: Any) -> Array:
    from quiver.baselines import qbp

    return qbp.restore(*given, excess=qbp.EXCESS, **settings)


def _qbp_published(*given: Any, **settings: Any) -> Array:
    from quiver.baselines import qbp

    return qbp.restore(*given, settings=qbp.AS_PUBLISHED, **settings)


def _path_merge(*given: Any, **settings: Any) -> Array:
    from quiver.baselines import path_merge

    return path_merge.restore(*given, **settings)


METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        Method("naive", naive_mean.restore, 11, "mean of the codes, taken as linear in light", 50),
        Method("moment", moment.restore, 11, "mean of the codes through the exact inverse response", 50),
        Method("likelihood", likelihood.restore, 11, "most likely light given the codes of one pixel", 300),
        Method(
            "transform-denoise",
            _transform_denoise,
            3,
            "stabilise, BM3D by the noise of each frame, exact unbiased inverse",
            1800,
        ),
        Method("qbp", _qbp, 11, "align, Wiener merge of the frames that exist, exact inverse response", 600),
        Method(
            "qbp-bm3d",
            _qbp_bm3d,
            11,
            "align, Wiener merge of the frames that exist, stabilise, BM3D by their noise, exact unbiased inverse",
            1800,
        ),
        Method(
            "path-merge", _path_merge, 11, "merge the frames that exist along smooth paths, exact inverse response", 500
        ),
        Method(
            "transform-denoise-published",
            _transform_denoise_published,
            3,
            "Transform Denoise with the arcsine for sums of binary samples, by the noise of each frame",
            1800,
        ),
        Method(
            "qbp-published",
            _qbp_published,
            11,
            "QBP of the frames that exist, with the article's noise estimate and whole-pixel shifts",
            600,
        ),
    )
}
