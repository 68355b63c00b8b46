"""Defines bit2bit (Liu et al., NeurIPS 2024): a 3-D U-Net that learns from one noisy clip alone, without sharp frames.

    training: each photon of a clip goes at random to the input or to the target; the network predicts the targets
    restoring: all photons are the input

Written from a description of the article. Look-ahead: the whole clip; clips above 32 frames are restored in pieces of
32 that overlap by half. A piece is extended to multiples of 8 frames by running backwards.

Two laws of the codes:

- Binomial, our design: a code is the sum of n binary planes, as of a SPAD array. The output is the logit of the
  probability pi of a one per plane. Of the n - a planes that did not give their one to the input, the target counts
  b ~ Binomial(n - a, q), q = pi (1 - p) / (1 - pi p), where p is the share of the input. p is an input of the network.
- Photons, `as_published`: the output is the log of the brightness up to a factor; each restored frame gets the mean of
  its codes. It holds for photon counts, as of a QIS with a gain near 1 whose codes are seldom saturated; voxels with
  the largest code do not train. The binomial law must not be used there: for photon counts of mean m its best answer
  to a code y is pi = m / (n - y + m), which keeps the fraction m/n of the noise.

Our reading: means of the photon law are over the voxels that count; the published program lets the others enter one.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from quiver.model.config import NetworkConfig, flag, real_number, whole_number
from quiver.model.rivals.edges import check_frames, pad_space, reflected

LEVELS = 4
GROUPS = 4  # of channels, in the normalisation
FREQUENCIES = 10  # sine channels of the input
PIECE = 32  # frames that are restored at once
DARKEST = 1e-9  # photons per voxel, so that a clip without any can be divided by its mean
LEAST_SHARE = 1e-6  # of the photons in the input; the largest is 1 minus this


@dataclass(frozen=True)
class Bit2BitConfig(NetworkConfig):
    """Configuration of bit2bit; the defaults are the published sizes with the binomial law."""

    width: int = 24  # channels at full size, a multiple of 4; twice, four and eight times as many below
    planes: int = 7  # of a code with the binomial law; the largest code with either
    dark: float = 0.0  # what the sensor adds without light, in units of the restored frames
    as_published: bool = False  # the photon law instead of the binomial one

    def __post_init__(self) -> None:
        """Raise `ValueError` for a value out of range."""
        whole_number("Bit2BitConfig.width", self.width, GROUPS, 1024)
        if self.width % GROUPS:
            raise ValueError(f"Bit2BitConfig.width must be a multiple of {GROUPS}, got {self.width}")
        whole_number("Bit2BitConfig.planes", self.planes, 1, 2**16 - 1)
        real_number("Bit2BitConfig.dark", self.dark, 0, 1e3)
        flag("Bit2BitConfig.as_published", self.as_published)


class Split(NamedTuple):
    """The photons of clips, each given to the input or to the target."""

    seen: Tensor  # [B, T, 1, H, W], the input: whole numbers
    target: Tensor  # [B, T, 1, H, W], all others
    share: Tensor  # [B], probability of the input


class Bit2Bit(nn.Module):
    """The network for grey frames."""

    look_ahead: ClassVar[int | None] = None  # all frames
    parts: ClassVar[tuple[int, int]] = (PIECE // 4, PIECE // 2)  # frames around a part of a long clip, and of the part
    multiple: ClassVar[int] = 2 ** (LEVELS - 1)  # px and frames that divide the sides inside

    def __init__(self, config: Bit2BitConfig | None = None) -> None:
        """Make the network of a configuration; the published sizes by default."""
        super().__init__()
        self.config = config = config or Bit2BitConfig()
        inputs = FREQUENCIES + (not config.as_published)  # and the share of the input
        widths = [config.width * 2**level for level in range(LEVELS)]
        self.down = nn.ModuleList(Block(a, b) for a, b in zip([inputs, *widths], widths, strict=False))
        self.rise = nn.ModuleList(nn.ConvTranspose3d(w, w // 2, 2, stride=2) for w in widths[:0:-1])
        self.up = nn.ModuleList(Block(w, w // 2) for w in widths[:0:-1])
        self.leave = nn.Conv3d(config.width, 1, 1)
        for module in self.modules():
            if isinstance(module, nn.Conv3d):
                nn.init.xavier_normal_(module.weight)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)

    def forward(self, frames: Tensor) -> Tensor:
        """[B, T, 1, H, W] of codes/(2^b - 1) -> restored [B, T, 1, H, W]; ValueError for another shape."""
        check_frames(frames)
        total = torch.zeros_like(frames)
        weights = frames.new_zeros(frames.shape[1], 1, 1, 1)
        for start, weight in pieces(frames.shape[1]):
            part = slice(start, start + len(weight))
            factors = frames.new_tensor(weight).view(-1, 1, 1, 1)
            total[:, part] += factors * self.piece(frames[:, part])
            weights[part] += factors
        return total / weights

    def piece(self, frames: Tensor) -> Tensor:
        """Frames [B, T, 1, H, W], all at once -> restored [B, T, 1, H, W], in units of white."""
        planes = self.config.planes
        output = self.output(planes * frames, frames.new_ones(len(frames))).to(frames.dtype)
        if not self.config.as_published:
            # The network gives the logit of the probability pi that a plane fires;
            # -ln(1 - sigmoid(x)) = softplus(x) are the photons of a plane.
            return F.softplus(output) - self.config.dark  # -ln(1 - pi)
        pixels = frames.shape[-2] * frames.shape[-1]
        # As published the output is a distribution of each frame's photons
        # over its pixels: a softmax, times the photons that the frame has.
        brightness = output - output.flatten(2).logsumexp(2).view(*output.shape[:2], 1, 1, 1)
        return frames.mean(dim=(2, 3, 4), keepdim=True) * pixels * brightness.exp() - self.config.dark

    def output(self, seen: Tensor, share: Tensor) -> Tensor:
        """Seen photons [B, T, 1, H, W] and the share that they are [B] -> logit or log-brightness [B, T, 1, H, W]."""
        count = seen.shape[1]
        height, width = seen.shape[-2:]
        order = reflected(0, -(-count // self.multiple) * self.multiple, count)
        volume = pad_space(seen, self.multiple)[:, order].transpose(1, 2)  # [B, 1, T, H, W]
        # Counts from 0 to many powers of ten, each seen at a scale where a network can tell them apart.
        channels = [torch.sin(volume * 10.0**-i) for i in range(FREQUENCIES)]
        if not self.config.as_published:
            channels.append(share.to(seen.dtype).view(-1, 1, 1, 1, 1).expand_as(volume))
        x = torch.cat(channels, dim=1)
        skips = []
        for level, block in enumerate(self.down):
            x = block(F.max_pool3d(x, 2) if level else x)
            skips.append(x)
        for rise, block, skip in zip(self.rise, self.up, skips[-2::-1], strict=True):
            x = block(torch.cat([rise(x), skip], dim=1))
        return self.leave(x).transpose(1, 2)[:, :count, :, :height, :width]


class Block(nn.Module):
    """Three convolutions, of which the last is added to the first; one normalisation serves all three."""

    def __init__(self, inputs: int, outputs: int) -> None:
        """Make the layers."""
        super().__init__()
        self.conv1 = nn.Conv3d(inputs, outputs, 3, padding=1)
        self.conv2, self.conv3 = (nn.Conv3d(outputs, outputs, 3, padding=1) for _ in range(2))
        self.norm = nn.GroupNorm(GROUPS, outputs)

    def forward(self, x: Tensor) -> Tensor:
        """[N, inputs, T, H, W] -> [N, outputs, T, H, W]."""
        first = self.norm(self.conv1(x))
        return F.relu(self.norm(self.conv3(F.relu(self.norm(self.conv2(first)))) + first))


def pieces(frames: int) -> Iterator[tuple[int, list[int]]]:
    """Yield the first frame of each piece of a clip, and the weights of its frames, largest in its middle."""
    length = min(frames, PIECE)
    for start in [*range(0, frames - length, PIECE // 2), frames - length]:
        yield start, [min(i + 1, length - i) for i in range(length)]


def split(codes: Tensor, generator: torch.Generator | None = None) -> Split:
    """Give each photon of codes [B, T, 1, H, W], whole numbers, to input or target, by a share drawn for each clip."""
    uniform = torch.rand(len(codes), generator=generator, dtype=codes.dtype, device=codes.device)
    share = LEAST_SHARE + (1 - 2 * LEAST_SHARE) * uniform
    seen = torch.binomial(codes, share.view(-1, 1, 1, 1, 1).expand_as(codes), generator=generator)
    return Split(seen, codes - seen, share)


def bit2bit_loss(network: Bit2Bit, codes: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Return the loss of one random split of codes [B, T, 1, H, W], whole numbers: a float32 scalar."""
    parts = split(codes, generator)
    output = network.output(parts.seen, parts.share).float()
    law = photon_loss if network.config.as_published else binomial_loss
    return law(output, parts, network.config.planes)


def binomial_loss(output: Tensor, parts: Split, planes: int) -> Tensor:
    """Return the negative log-likelihood of the target, per plane that is not in the input: a scalar.

    Output [B, T, 1, H, W] is the logit of pi. That of q is larger by ln(1 - p).
    """
    logit = output + torch.log1p(-parts.share).view(-1, 1, 1, 1, 1)
    left = planes - parts.seen
    return (left * F.softplus(logit) - parts.target * logit).sum() / left.sum().clamp(min=1)


def photon_loss(output: Tensor, parts: Split, planes: int) -> Tensor:
    """Return the cross-entropy of where target photons fall, a scalar: blind to the brightness of a clip.

    Output [B, T, 1, H, W] is the log of the brightness. Binary voxels that gave their photon to the input do not count;
    saturated voxels of larger codes do not count.
    """
    admitted = (parts.seen == 0 if planes == 1 else parts.seen + parts.target < planes).flatten(1)
    values = output.flatten(1)
    target = parts.target.flatten(1)
    target = target / target.mean(dim=1, keepdim=True).clamp(min=DARKEST) * admitted
    count = admitted.sum(dim=1).clamp(min=1).to(values.dtype)
    hidden = values.masked_fill(~admitted, torch.finfo(values.dtype).min)
    log_mean = hidden.logsumexp(dim=1) - count.log()
    return ((log_mean * target.sum(dim=1) - (values * target).sum(dim=1)) / count).mean()
