"""Prepares the inputs of MergeNet: merged frames on the scale phi, in units of their noise, with maps of what is known.

    Merged (path_merge.py) -> phi (information_domain.py) -> channels [6, H, W] -> MergeNet -> phi again -> photons

All channels describe a pixel and its near surroundings; none depends on the size of the frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy import ndarray as Array
from torch import Tensor

from quiver.baselines.information_domain import InformationDomain, information_domain
from quiver.baselines.motion_paths import box_mean
from quiver.baselines.path_merge import Merged, stream
from quiver.data.codes import Codes

LOCAL = 8  # px: half the side of the squares whose mean is the local level
UNIT = 4.0  # deviations of the noise that a channel's 1 stands for
LEAST_LIGHT = 1e-3  # photons, added to light before it is compared with its noise


@dataclass(frozen=True)
class MergeInputs:
    """Inputs of one frame, float32."""

    channels: Tensor  # [6, H, W]
    phi: Tensor  # [H, W], of the merged mean code
    deviation: Tensor  # [H, W], of the noise of phi


def middle_inputs(codes: Codes) -> tuple[MergeInputs, InformationDomain]:
    """Return the inputs of the middle frame of a window of codes, cut to its size, and the tables of its sensor."""
    domain = information_domain(codes.sensor, codes.exposure)
    length, height, width = codes.shape
    window, middle = codes.read(0, length), length // 2
    found = merge_inputs(next(stream(lambda t: window[t], length, domain, length, range(middle, middle + 1))), domain)
    cut = MergeInputs(*(x[..., :height, :width] for x in (found.channels, found.phi, found.deviation)))
    return cut, domain


def merge_inputs(merged: Merged, domain: InformationDomain) -> MergeInputs:
    """Return the inputs of a merged frame [H, W].

    Channels: the merged phi over its local mean; the frame alone, the nearest three and the unmoved window over the
    merged phi, each in units of its noise; the deviation of the noise; and the logarithm of the light over its noise,
    which is low where codes carry nothing.
    """
    phi, deviation = _stabilised(merged.mean_code, merged.count, domain)
    alone, alone_deviation = _stabilised(merged.alone, np.ones_like(merged.alone), domain)
    near, near_deviation = _stabilised(merged.near, merged.near_count, domain)
    still, still_deviation = _stabilised(merged.still, np.full_like(merged.still, merged.frames), domain)
    local = box_mean(torch.from_numpy(phi)[None], LOCAL)[0].numpy()
    light = np.interp(local, domain.phi, domain.photons)
    blurred = np.interp(local, domain.phi, domain.slope) * deviation
    known = np.log2((light + LEAST_LIGHT) / (blurred + LEAST_LIGHT)).clip(-4, 8) / UNIT
    channels = [
        (phi - local) / (UNIT * deviation),
        (alone - phi) / (UNIT * alone_deviation),
        (near - phi) / (UNIT * near_deviation),
        (still - phi) / (UNIT * still_deviation),
        deviation,
        known,
    ]
    return MergeInputs(
        torch.from_numpy(np.stack(channels).astype(np.float32)), torch.from_numpy(phi), torch.from_numpy(deviation)
    )


def _stabilised(mean_code: Array, count: Array, domain: InformationDomain) -> tuple[Array, Array]:
    """Return phi and its deviation, float32 [H, W], of the mean of `count` codes; half a count below saturation."""
    most = np.maximum(domain.mean_code[-1] - 0.5 / count, domain.mean_code[0])
    mean_code = np.minimum(mean_code, most)
    deviation = domain.noise(mean_code) / np.sqrt(count)
    return domain.forward(mean_code), deviation.astype(np.float32)
