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

    def taken(self, places: Sequence[int]) -> MergeInputs:
        """Return the inputs of these windows."""
        return MergeInputs(*(torch.stack([x[i] for i in places]) for x in (self.channels, self.phi, self.deviation)))

    def cut(self, height: int, width: int) -> MergeInputs:
        """Return the first rows and columns."""
        return MergeInputs(*(x[..., :height, :width] for x in (self.channels, self.phi, self.deviation)))


def middle_inputs(codes: Codes, kept: tuple[int, int] | None = None) -> tuple[MergeInputs, InformationDomain]:
    """Return the inputs of the middle frame of a window of codes, cut to its size, and the tables of its sensor.

    The window `kept` so many frames before and after the middle one; None: all.
    """
    domain = information_domain(codes.sensor, codes.exposure)
    window = as_codes(codes.read(0, codes.shape[0])[None], torch.device("cpu"))
    return inputs_of_windows(window, domain_tables(domain, window.device), kept), domain


def batch_inputs(
    codes: Tensor, sensors: Sequence[tuple[Sensor, float]], kept: Sequence[tuple[int, int]]
) -> tuple[MergeInputs, list[InformationDomain]]:
    """Return the inputs of the middle frames of windows of codes [B, K, H, W] where the codes are, and the tables of
    the sensor and exposure [s] of each window, which `kept` so many frames before and after the middle one.
    """
    domains = [information_domain(sensor, exposure) for sensor, exposure in sensors]
    parts: list[MergeInputs] = []
    order: list[int] = []
    for each in sorted(set(kept)):  # windows of equal length are merged together
        places = [i for i, own in enumerate(kept) if own == each]
        tables = tables_of_batch([domains[i] for i in places], codes.device)
        parts.append(inputs_of_windows(torch.stack([codes[i] for i in places]), tables, each))
        order += places
    return joined(parts).taken([order.index(i) for i in range(len(order))]), domains


def joined(parts: Sequence[MergeInputs]) -> MergeInputs:
    """Return the inputs of all windows of some batches."""
    fields = zip(*((part.channels, part.phi, part.deviation) for part in parts), strict=True)
    return MergeInputs(*(torch.cat(tensors) for tensors in fields))


def inputs_of_windows(codes: Tensor, tables: DomainTables, kept: tuple[int, int] | None = None) -> MergeInputs:
    """Return the inputs of the middle frames of windows of codes [B, K, H, W], where the codes are.

    The windows `kept` so many frames before and after the middle one; None: all.
    """
    frames, height, width = codes.shape[1:]
    middle = frames // 2
    before = middle if kept is None else min(kept[0], middle)
    after = frames - 1 - middle if kept is None else min(kept[1], frames - 1 - middle)
    offsets = range(-before, after + 1)
    codes = codes[:, middle - before : middle + after + 1]
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
