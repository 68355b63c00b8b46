"""Prepares the inputs of MergeNet: merged frames on the scale phi, in units of their noise, with maps of what is known.

    Merged (path_merge.py) -> phi (information_domain.py) -> channels [B, 17, H, W] -> MergeNet -> phi again -> photons

All channels describe a pixel and its near surroundings; none depends on the size of the frame. They are made where the
merged frames are, for a batch of windows at once. Four tell what looks alike near by (self_similarity.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from quiver.baselines.domain_tables import DomainTables, domain_tables, tables_of_batch
from quiver.baselines.information_domain import InformationDomain, information_domain
from quiver.baselines.path_merge import Merged, as_codes, merge, prepared
from quiver.baselines.paths.moved_frames import box_mean
from quiver.baselines.self_similarity import mean_of_alike
from quiver.data.codes import Codes, Sensor

LOCAL = 8  # px: half the side of the squares whose mean code tells the local level
NEARBY = 2  # px, likewise, of the level around a pixel, and of the noise of groups
UNIT = 4.0  # deviations of the noise that a channel's 1 stands for
MOST = 4.0  # of a channel of a group, and of what looks alike: another scene tells no more
ALIKE = 4  # channels of what looks alike
LEAST_LIGHT = 1e-3  # photons, added to light before it is compared with its noise


@dataclass(frozen=True, eq=False)
class MergeInputs:
    """Inputs of one frame of each window, float32."""

    channels: Tensor  # [B, 17, H, W]
    phi: Tensor  # [B, H, W], of the merged mean code
    deviation: Tensor  # [B, H, W], of the noise of phi

    def cut(self, height: int, width: int) -> MergeInputs:
        """Return the first rows and columns."""
        return MergeInputs(*(x[..., :height, :width] for x in (self.channels, self.phi, self.deviation)))


def middle_inputs(codes: Codes) -> tuple[MergeInputs, InformationDomain]:
    """Return the inputs of the middle frame of a window of codes, cut to its size, and the tables of its sensor."""
    domain = information_domain(codes.sensor, codes.exposure)
    window = as_codes(codes.read(0, codes.shape[0])[None], torch.device("cpu"))
    return inputs_of_windows(window, domain_tables(domain, window.device)), domain


def batch_inputs(codes: Tensor, sensors: Sequence[tuple[Sensor, float]]) -> tuple[MergeInputs, list[InformationDomain]]:
    """Return the inputs of the middle frames of windows of codes [B, K, H, W] where the codes are, and the tables of
    the sensor and exposure [s] of each window.
    """
    domains = [information_domain(sensor, exposure) for sensor, exposure in sensors]
    return inputs_of_windows(codes, tables_of_batch(domains, codes.device)), domains


def inputs_of_windows(codes: Tensor, tables: DomainTables) -> MergeInputs:
    """Return the inputs of the middle frames of windows of codes [B, K, H, W], where the codes are."""
    frames, height, width = codes.shape[1:]
    offsets = range(-(frames // 2), frames - frames // 2)
    return merge_inputs(merge(prepared(codes, tables), offsets, tables), tables).cut(height, width)


@torch.no_grad()
def merge_inputs(merged: Merged, tables: DomainTables) -> MergeInputs:
    """Return the inputs of merged frames [B, H, W].

    Channels: the merged phi over its local level; the frame alone, the nearest three, the unmoved window and the level
    around the pixel over the merged phi, each in units of its noise; the deviation of the noise; the logarithm of the
    light over its noise, which is low where codes carry nothing; and six groups of moved frames over the merged frame,
    in units of their noise, which tell what merging left out; what looks alike in the merged frame and in the frame
    alone. Levels are phi of pooled codes: phi of single pixels loses light near saturation.
    """
    phi, deviation = tables.stabilised(merged.mean_code, merged.count)
    groups = merged.groups.shape[1]
    channels = phi.new_empty(len(phi), 7 + groups + ALIKE, *phi.shape[1:])
    local = tables.phi(box_mean(merged.mean_code, LOCAL))
    own = (deviation * UNIT).reciprocal_()
    torch.mul(phi - local, own, out=channels[:, 0])
    counts: tuple[Tensor | float, ...] = (1.0, merged.near_count, float(merged.frames))
    others = zip((merged.alone, merged.near, merged.still), counts, strict=True)
    for i, (mean_code, count) in enumerate(others, 1):
        other, noise = tables.stabilised(mean_code, count)
        torch.div(other.sub_(phi), noise.mul_(UNIT), out=channels[:, i])
    around = box_mean(merged.mean_code, NEARBY)
    torch.mul(tables.phi(around).sub_(phi), own, out=channels[:, 4])
    channels[:, 5] = deviation
    light, slope = tables.light_and_slope(local)
    # Light over its noise, in octaves: it tells the network where codes are dark or saturated.
    known = light.add_(LEAST_LIGHT).div_(slope.mul_(deviation).add_(LEAST_LIGHT)).log2_().clamp_(-4, 8)
    torch.div(known, UNIT, out=channels[:, 6])
    _groups(merged, around, tables, out=channels[:, 7 : 7 + groups])
    _alike(merged, phi, deviation, tables, out=channels[:, 7 + groups :])
    return MergeInputs(channels, phi, deviation)


def _groups(merged: Merged, around: Tensor, tables: DomainTables, out: Tensor) -> None:
    """Write groups over the merged frame [B, 6, H, W], in units of noise at the level around; 0 without a frame."""
    torch.sub(merged.groups, merged.mean_code[:, None], out=out)
    noise = tables.variance(around).rsqrt_().div_(UNIT)
    out.mul_(merged.group_counts.sqrt()).mul_(noise[:, None]).clamp_(-MOST, MOST)


def _alike(merged: Merged, phi: Tensor, deviation: Tensor, tables: DomainTables, out: Tensor) -> None:
    """Write what looks alike in the merged frame and in the frame alone, [B, 4, H, W]: each over the merged frame in
    units of its noise, and the octaves by which it has less noise.
    """
    alone, noise = tables.stabilised(merged.alone, 1.0)
    means, variances = mean_of_alike(torch.cat([phi, alone]), torch.cat([deviation, noise]).square_())
    for i, (mean, variance) in enumerate(zip(means.chunk(2), variances.chunk(2), strict=True)):
        torch.div(mean - phi, deviation * UNIT, out=out[:, 2 * i]).clamp_(-MOST, MOST)
        torch.div(deviation.square().div_(variance).log2_(), 2 * UNIT, out=out[:, 2 * i + 1])
