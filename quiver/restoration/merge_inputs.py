"""Prepares the inputs of MergeNet: merged frames on the scale phi, in units of their noise, with maps of what is known.

    Merged (path_merge.py) -> phi (information_domain.py) -> channels [13, H, W] -> MergeNet -> phi again -> photons

All channels describe a pixel and its near surroundings; none depends on the size of the frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy import ndarray as Array
from torch import Tensor

from quiver.baselines.information_domain import FLOOR, InformationDomain, information_domain
from quiver.baselines.path_merge import Merged, stream
from quiver.baselines.paths.moved_frames import box_mean
from quiver.data.codes import Codes

LOCAL = 8  # px: half the side of the squares whose mean code tells the local level
NEARBY = 2  # px, likewise, of the level around a pixel, and of the noise of groups
UNIT = 4.0  # deviations of the noise that a channel's 1 stands for
MOST = 4.0  # of a channel of a group: a frame of another scene tells no more
LEAST_LIGHT = 1e-3  # photons, added to light before it is compared with its noise


@dataclass(frozen=True)
class MergeInputs:
    """Inputs of one frame, float32."""

    channels: Tensor  # [13, H, W]
    phi: Tensor  # [H, W], of the merged mean code
    deviation: Tensor  # [H, W], of the noise of phi


def middle_inputs(codes: Codes) -> tuple[MergeInputs, InformationDomain]:
    """Return the inputs of the middle frame of a window of codes, cut to its size, and the tables of its sensor."""
    domain = information_domain(codes.sensor, codes.exposure)
    length, height, width = codes.shape
    window = codes.read(0, length)
    middle = length // 2
    found = merge_inputs(next(stream(lambda t: window[t], length, domain, length, range(middle, middle + 1))), domain)
    cut = MergeInputs(*(x[..., :height, :width] for x in (found.channels, found.phi, found.deviation)))
    return cut, domain


def merge_inputs(merged: Merged, domain: InformationDomain) -> MergeInputs:
    """Return the inputs of a merged frame [H, W].

    Channels: the merged phi over its local level; the frame alone, the nearest three, the unmoved window and the level
    around the pixel over the merged phi, each in units of its noise; the deviation of the noise; the logarithm of the
    light over its noise, which is low where codes carry nothing; and six groups of moved frames over the merged frame,
    in units of their noise, which tell what merging left out. Levels are phi of pooled codes: phi of single pixels
    loses light near saturation.
    """
    phi, deviation = _stabilised(merged.mean_code, merged.count, domain)
    alone, alone_deviation = _stabilised(merged.alone, np.ones_like(merged.alone), domain)
    near, near_deviation = _stabilised(merged.near, merged.near_count, domain)
    still, still_deviation = _stabilised(merged.still, np.full_like(merged.still, merged.frames), domain)
    mean_code = torch.from_numpy(merged.mean_code)[None]
    around = box_mean(mean_code, NEARBY)[0].numpy()
    local = domain.forward(box_mean(mean_code, LOCAL)[0].numpy())
    light = np.interp(local, domain.phi, domain.photons)
    blurred = np.interp(local, domain.phi, domain.slope) * deviation
    # Light over its noise, in octaves: it tells the network where codes are dark or saturated.
    known = np.log2((light + LEAST_LIGHT) / (blurred + LEAST_LIGHT)).clip(-4, 8) / UNIT
    channels = [
        (phi - local) / (UNIT * deviation),
        (alone - phi) / (UNIT * alone_deviation),
        (near - phi) / (UNIT * near_deviation),
        (still - phi) / (UNIT * still_deviation),
        (domain.forward(around) - phi) / (UNIT * deviation),
        deviation,
        known,
        *_groups(merged, around, domain),
    ]
    stacked = np.stack(channels, dtype=np.float32, casting="same_kind")
    return MergeInputs(torch.from_numpy(stacked), torch.from_numpy(phi), torch.from_numpy(deviation))


def _groups(merged: Merged, around: Array, domain: InformationDomain) -> Array:
    """Return groups over the merged frame [6, H, W], in units of their noise at the level around; 0 without a frame."""
    variance = np.maximum(np.interp(around, domain.mean_code, domain.variance), FLOOR)
    apart = (merged.groups - merged.mean_code) * np.sqrt(merged.group_counts / variance) / UNIT
    found: Array = apart.clip(-MOST, MOST)
    return found


def _stabilised(mean_code: Array, count: Array, domain: InformationDomain) -> tuple[Array, Array]:
    """Return phi and its deviation, float32 [H, W], of the mean of `count` codes; half a count below saturation."""
    # At saturation a mean code tells no light; half a count below, the estimate is that of the moment inverse.
    most = np.maximum(domain.mean_code[-1] - 0.5 / count, domain.mean_code[0])
    mean_code = np.minimum(mean_code, most)
    deviation = domain.noise(mean_code) / np.sqrt(count)
    return domain.forward(mean_code), deviation.astype(np.float32)
