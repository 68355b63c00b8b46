"""Denoises pictures on a GPU with OptiX's denoiser, as Mitsuba offers it.

It has not run yet: no machine with a GPU was at hand. `qsim.backend.gpu_denoises` tests it in a child process first.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.backend import GPU_VARIANT
from qsim.rendering.engine import in_own_variant


def denoised(colour: Array, albedo: Array) -> Array:
    """Return a picture, float32 [H, W, 3], without its pixel noise; `albedo` [H, W, 3], in 0..1, has none.

    Normals are left out: OptiX wants them in the axes of a camera, which a mean over an exposure does not have.
    """
    return _OptixDenoiser().denoised(colour, albedo)


@dataclass(frozen=True)
class _OptixDenoiser:
    variant: str = GPU_VARIANT

    @in_own_variant
    def denoised(self, colour: Array, albedo: Array) -> Array:
        import mitsuba as mi

        height, width = colour.shape[:2]
        cleaned = _of_size(width, height)(mi.TensorXf(colour), albedo=mi.TensorXf(albedo))
        return np.array(cleaned, np.float32)


@lru_cache(maxsize=2)
def _of_size(width: int, height: int) -> Any:
    """Return Mitsuba's denoiser of pictures of one size; making it takes memory and time."""
    import mitsuba as mi

    return mi.OptixDenoiser(input_size=mi.ScalarVector2u(width, height), albedo=True)
