"""Defines the building blocks of QUIVER, in the order in which they process a frame.

Conventions of all blocks:

* `conv` has stride 1, zero padding (k-1)/2 and a bias; GELU is the exact erf form.
* There is no normalisation layer, no dropout, and no activation on any output.
* C is the channel unit.
* A flow is in pixels of its scale, channel 0 = x (right), 1 = y (down). It is given on the grid of frame t+1 and points
  into frame t.
* Values of frames are in units of x = photons/white.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from quiver.model.deformable import deform_conv2d, warp

RADIUS = 5  # frames before and after the restored one
WINDOW = 2 * RADIUS + 1
NEIGHBOURS = 5  # consecutive frames that a feature extractor takes
PASSES = 5  # of the pre-denoiser's block
BLOCKS = 11  # of the recurrent cell
OFFSET_LIMIT = 10.0  # px, largest offset that the alignment adds to the flow
# standardisation of the flow network's input; kept as float32 buffers
GREY_MEAN = 0.449
GREY_DEVIATION = 0.226


@dataclass(frozen=True)
class Output:
    """Result of a network, in units of x = photons/white, not clamped; None where the network lacks the part."""

    denoised: Tensor | None  # [B, T, 1, H, W], each frame denoised alone
    scale1: Tensor  # [B, T-10, 1, H, W], restored frames 5 .. T-6
    scale2: Tensor | None  # [B, T-10, 1, H/2, W/2]
    scale4: Tensor | None  # [B, T-10, 1, H/4, W/4]
    # [B, T-1, 2, H/s, W/s] for s = 1, 2, 4, pixels of that scale, on the grid of frame t+1 and pointing into frame t
    flows: tuple[Tensor, ...] | None = None


def check_input(x: Tensor, multiple: int) -> None:
    """Raise ValueError unless x is [B, T >= 11, 1, H, W] with sides that are multiples of `multiple`."""
    if x.ndim != 5 or x.shape[2] != 1 or x.shape[1] < WINDOW:
        raise ValueError(f"the network takes [B, T, 1, H, W] with T >= {WINDOW}, got {tuple(x.shape)}; pad time first")
    if x.shape[3] % multiple or x.shape[4] % multiple or not x.shape[3] or not x.shape[4]:
        raise ValueError(f"height and width must be multiples of {multiple}, got {tuple(x.shape[3:])}; pad space first")


def conv(inputs: int, outputs: int, kernel: int, stride: int = 1, bias: bool = True) -> nn.Conv2d:
    """Return a convolution [N, inputs, H, W] -> [N, outputs, H/stride, W/stride] with zero padding."""
    return nn.Conv2d(inputs, outputs, kernel, stride, padding=kernel // 2, bias=bias)


def upsample(inputs: int, outputs: int) -> nn.ConvTranspose2d:
    """Return a transposed convolution [N, inputs, H, W] -> [N, outputs, 2H, 2W]."""
    return nn.ConvTranspose2d(inputs, outputs, 3, stride=2, padding=1, output_padding=1)


def resize(frames: Tensor, height: int, width: int) -> Tensor:
    """Resize [..., C, H, W] to [..., C, height, width], bilinear, without antialiasing."""
    if frames.shape[-2:] == (height, width):
        return frames
    flat = frames.reshape(-1, *frames.shape[-3:])
    small = F.interpolate(flat, size=(height, width), mode="bilinear", align_corners=False)
    return small.view(*frames.shape[:-2], height, width)


def join(*tensors: Tensor) -> Tensor:
    """Concatenate [N, C_i, H, W] along channels, channels last in memory: convolutions then are faster on a CPU."""
    return torch.cat(tensors, dim=1).contiguous(memory_format=torch.channels_last)


class ResidualDenseBlock(nn.Module):
    """Three dense layers that add `growth` channels each, then a 1 x 1 convolution to `channels`, plus the input."""

    def __init__(self, channels: int, growth: int, activation: type[nn.Module] = nn.GELU) -> None:
        super().__init__()
        self.layers = nn.ModuleList(conv(channels + i * growth, growth, 3) for i in range(3))
        self.merge = conv(channels + 3 * growth, channels, 1)
        self.activation = activation()

    def forward(self, x: Tensor) -> Tensor:
        """[N, channels, H, W] -> the same shape."""
        y = x
        for layer in self.layers:
            y = join(y, self.activation(layer(y)))
        return self.merge(y) + x


class PreDenoiser(nn.Module):
    """Denoises each frame alone: one residual dense block runs several times, its results are fused and added."""

    def __init__(self, channels: int, growth: int) -> None:
        super().__init__()
        self.lift = conv(1, channels, 1)
        self.enter = conv(channels, channels, 3)
        self.block = ResidualDenseBlock(channels, growth, nn.ReLU)
        self.fuse = nn.Sequential(conv(PASSES * channels, channels, 1), conv(channels, channels, 3))
        self.leave = conv(channels, 1, 3)

    def forward(self, x: Tensor) -> Tensor:
        """[N, 1, H, W] -> the same shape."""
        shallow = self.lift(join(x))
        results = [self.enter(shallow)]
        for _ in range(PASSES):
            results.append(self.block(results[-1]))
        return self.leave(self.fuse(join(*results[1:])) + shallow) + x


class FlowNetwork(nn.Module):
    """Estimates the flow of grey frames from coarse to fine (Ranjan & Black 2017, "SpyNet")."""

    mean: Tensor
    deviation: Tensor

    def __init__(self, channels: Sequence[int], kernel: int, levels: int = 4) -> None:
        super().__init__()
        self.register_buffer("mean", torch.full((1, 1, 1, 1), GREY_MEAN, dtype=torch.float32))
        self.register_buffer("deviation", torch.full((1, 1, 1, 1), GREY_DEVIATION, dtype=torch.float32))
        self.levels = nn.ModuleList(self._level(channels, kernel) for _ in range(levels))

    @staticmethod
    def _level(channels: Sequence[int], kernel: int) -> nn.Sequential:
        layers: list[nn.Module] = []
        for inputs, outputs in zip((4, *channels), channels, strict=False):
            layers += [conv(inputs, outputs, kernel), nn.ReLU()]
        return nn.Sequential(*layers, conv(channels[-1], 2, kernel))

    def forward(self, reference: Tensor, support: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Grey frames [N, 1, H, W] -> flows [N, 2, H/s, W/s] from `reference` into `support`, s = 1, 2, 4."""
        height, width = reference.shape[2:]
        coarsest = 2 ** len(self.levels)  # pixels per pixel of the zero flow at the start
        padded = tuple(2 * coarsest * math.ceil(side / (2 * coarsest)) for side in (height, width))
        pyramid = [torch.cat([(resize(v, *padded) - self.mean) / self.deviation for v in (reference, support)], dim=1)]
        for _ in range(len(self.levels) - 1):
            pyramid.insert(0, F.avg_pool2d(pyramid[0], 2))
        flow = reference.new_zeros(reference.shape[0], 2, padded[0] // coarsest, padded[1] // coarsest)
        flows = []
        for level, pair in zip(self.levels, pyramid, strict=True):
            # Twice as many pixels: a flow in pixels doubles.
            up = 2 * F.interpolate(flow, scale_factor=2, mode="bilinear", align_corners=True)
            warped = warp(pair[:, 1:], up, "border")
            flow = level(join(pair[:, :1], warped.to(up.dtype), up)) + up
            flows.append(flow)
        return tuple(self._to_size(flows[-1 - i], height // k, width // k) for i, k in enumerate((1, 2, 4)))  # type: ignore[return-value]

    @staticmethod
    def _to_size(flow: Tensor, height: int, width: int) -> Tensor:
        # Each component is resized as its own axis is.
        # Filled on the device: numbers that are copied to a GPU would make the host wait.
        factors = [flow.new_full((), new / old) for new, old in ((width, flow.shape[3]), (height, flow.shape[2]))]
        return resize(flow, height, width) * torch.stack(factors).view(1, 2, 1, 1)


def neighbourhoods(frames: Tensor, before: int = NEIGHBOURS // 2, after: int = NEIGHBOURS // 2) -> Tensor:
    """Stack every frame with two neighbours on each side as channels; zeros before the first and after the last.

    [B, T, 1, H, W] -> [B, T + before + after - 4, 5, H, W].
    """
    padded = F.pad(frames, (0, 0, 0, 0, 0, 0, before, after))
    stacks = padded.unfold(1, NEIGHBOURS, 1).permute(0, 1, 2, 5, 3, 4)
    return stacks.reshape(*stacks.shape[:2], -1, *stacks.shape[4:])


class Extractor(nn.Module):
    """Linear features of a stream at scales 1, 2, 4: 3-D convolutions of 5 x 5 x 5.

    For one frame, such a convolution is a 2-D convolution over five stacked frames. That form computes a frame alone,
    and it is faster for few channels.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.scale1 = nn.Conv3d(1, channels, NEIGHBOURS)
        self.scale2 = nn.Conv3d(1, channels, NEIGHBOURS)
        self.scale4 = nn.Conv3d(1, channels, NEIGHBOURS)

    def forward(self, stacks: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """[N, 5, H, W] (see `neighbourhoods`) -> features [N, C, H/s, W/s] for s = 1, 2, 4."""
        stacks = join(stacks)
        half = resize(stacks, stacks.shape[2] // 2, stacks.shape[3] // 2)
        return (
            self._convolve(stacks, self.scale1, 1),
            self._convolve(stacks, self.scale2, 2),
            self._convolve(half, self.scale4, 2),
        )

    @staticmethod
    def _convolve(stacks: Tensor, layer: nn.Conv3d, stride: int) -> Tensor:
        return F.conv2d(stacks, layer.weight.flatten(1, 2), layer.bias, stride, padding=NEIGHBOURS // 2)


class Alignment(nn.Module):
    """Aligns the features of frame t-1 to frame t by a deformable convolution along the flow; one for all scales."""

    def __init__(self, channels: int, groups: int) -> None:
        super().__init__()
        self.pairs = groups * 3**2  # number of offset vectors: one for each tap of each group
        self.offsets = nn.Sequential(
            conv(2 * channels + 2, channels, 3),
            nn.LeakyReLU(0.1),
            conv(channels, channels, 3),
            nn.LeakyReLU(0.1),
            conv(channels, channels, 3),
            nn.LeakyReLU(0.1),
            conv(channels, 3 * self.pairs, 3),
        )
        self.weight = nn.Parameter(torch.empty(channels, channels, 3, 3))
        self.bias = nn.Parameter(torch.zeros(channels))
        bound = 1 / math.sqrt(3**2 * channels)
        nn.init.uniform_(self.weight, -bound, bound)
        last = self.offsets[-1]
        assert isinstance(last, nn.Conv2d)
        assert last.bias is not None
        # An untrained alignment follows the flow alone: no offset of its own, and a mask of 1/2.
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)

    def forward(self, previous: Tensor, current: Tensor, flow: Tensor) -> Tensor:
        """Features [N, C, h, w] of frames t-1 and t, flow [N, 2, h, w] -> aligned features [N, C, h, w]."""
        warped = warp(previous, flow, "zeros")
        raw = self.offsets(join(warped.to(current.dtype), current, flow))
        # Offsets in (dy, dx) for each tap; the flow comes as (x, y) and is flipped.
        own = OFFSET_LIMIT * torch.tanh(raw[:, : 2 * self.pairs])
        offset = own + flow.flip(1).repeat(1, self.pairs, 1, 1)
        mask = torch.sigmoid(raw[:, 2 * self.pairs :])
        return deform_conv2d(previous, offset, self.weight, self.bias, mask, padding=1)


class GatedFusion(nn.Module):
    """Fuses the aligned denoised and noisy streams pixel by pixel: merge(GELU(gate z) * (value z))."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.gate = nn.Linear(2 * channels, 2 * channels)
        self.value = nn.Linear(2 * channels, 2 * channels)
        self.merge = nn.Linear(2 * channels, channels)

    def forward(self, denoised: Tensor, noisy: Tensor) -> Tensor:
        """Two [N, C, h, w] -> [N, C, h, w]; linear layers run as 1 x 1 convolutions, so that no axis moves."""
        z = join(denoised, noisy)
        return self._linear(self.merge, F.gelu(self._linear(self.gate, z)) * self._linear(self.value, z))

    @staticmethod
    def _linear(layer: nn.Linear, x: Tensor) -> Tensor:
        return F.conv2d(x, layer.weight[:, :, None, None], layer.bias)


class RecurrentCell(nn.Module):
    """Fuses the features of one frame at three scales with a state at 1/4 scale.

    `encode` is the part without state, `step` the recurrent part, `state` the next state from the result of `step`.
    """

    def __init__(self, channels: int, growth: int) -> None:
        super().__init__()
        c = channels
        self.image1 = conv(1, c, 5)
        self.image2 = conv(1, c, 3)
        self.image4 = conv(1, c, 3)
        self.fuse1 = conv(2 * c, 4 * c, 1)
        self.block1 = ResidualDenseBlock(4 * c, c)
        self.down1 = conv(4 * c, 4 * c, 5, stride=2)
        self.block2 = ResidualDenseBlock(6 * c, 3 * c // 2)
        self.down2 = conv(6 * c, 4 * c, 5, stride=2)
        self.join = ResidualDenseBlock(8 * c, c)
        self.shrink = conv(8 * c, 4 * c, 3)
        self.blocks = nn.ModuleList(ResidualDenseBlock(4 * c, growth) for _ in range(BLOCKS))
        self.collect = conv(4 * c * BLOCKS, 4 * c, 1)
        self.smooth = conv(4 * c, 4 * c, 3)
        self.state = nn.Sequential(conv(4 * c, 2 * c, 3), ResidualDenseBlock(2 * c, 2 * c), conv(2 * c, 2 * c, 3))

    def encode(self, images: Sequence[Tensor], fused: Sequence[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Images [N, 1, h, w] and fused features [N, C, h, w], three scales each -> R1, R2 [4C], entry [6C at 1/4]."""
        r1 = self.fuse1(join(self.image1(images[0]), fused[0]))
        r2 = self.down1(self.block1(r1))
        middle = join(r2, self.image2(images[1]), fused[1])
        entry = join(self.down2(self.block2(middle)), self.image4(images[2]), fused[2])
        return r1, r2, entry

    def step(self, entry: Tensor, state: Tensor) -> Tensor:
        """Entry [N, 6C, h, w] and state [N, 2C, h, w] at 1/4 scale -> R4 [N, 4C, h, w]."""
        y = self.shrink(self.join(join(entry, state)))
        results = []
        for block in self.blocks:
            y = block(y)
            results.append(y)
        return self.smooth(self.collect(join(*results)))


class TemporalAttention(nn.Module):
    """Channel self-attention over the R4 of a window, stacked with the centre frame last."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        width = 4 * channels * WINDOW
        self.enter = conv(width, width, 3, bias=False)
        self.spread = nn.Conv2d(width, width, 3, padding=1, groups=width, bias=False)
        self.qkv = conv(width, 3 * width, 1, bias=False)
        self.project = conv(width, width, 1, bias=False)
        self.leave = conv(width, 4 * channels, 1, bias=False)

    def forward(self, window: Sequence[Tensor]) -> Tensor:
        """R4 [N, 4C, h, w] of an odd number of frames in time order -> [N, 4C, h, w] for the centre frame."""
        centre = len(window) // 2
        c = self.enter(join(*window[:centre], *window[centre + 1 :], window[centre]))
        q, k, v = self.qkv(self.spread(c)).flatten(2).chunk(3, dim=1)
        # Attention between channels, not pixels (Restormer, Zamir et al. 2022): its cost is linear in the pixels.
        cosines = F.normalize(q, dim=2) @ F.normalize(k, dim=2).transpose(1, 2)  # of every pair of channels
        attended = (cosines.softmax(dim=2) @ v).view_as(c)
        return self.leave(self.project(attended) + c)


class Refinement(nn.Module):
    """Makes the picture of one scale: channel attention, an image branch, and a hidden branch for the next scale."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        c = channels
        self.enter = conv(8 * c, 8 * c, 1)
        self.body = nn.Sequential(conv(8 * c, 8 * c, 1), nn.GELU(), conv(8 * c, 8 * c, 3))
        self.gate = nn.Sequential(
            conv(8 * c, c // 2, 1, bias=False), nn.ReLU(), conv(c // 2, 8 * c, 1, bias=False), nn.Sigmoid()
        )
        widths = (8 * c, 8 * c, 6 * c, 4 * c)
        self.hidden = nn.Sequential(*_gelu_chain(widths), nn.GELU(), upsample(4 * c, 4 * c))
        self.picture = nn.Sequential(*_gelu_chain((8 * c, 6 * c, 4 * c, 2 * c, c)), conv(c, 1, 3))
        self.next_picture = upsample(1, 1)

    def forward(self, feature: Tensor, hidden: Tensor, picture: Tensor) -> tuple[Tensor, Tensor]:
        """Feature, hidden [N, 4C, h, w], picture [N, 1, h, w] -> new picture [N, 1, h, w], g [N, 8C, h, w]."""
        g0 = self.enter(join(feature, hidden))
        b = self.body(g0)
        g = self.gate(b.mean(dim=(2, 3), keepdim=True)) * b + g0
        return self.picture(g) + picture, g

    def onward(self, g: Tensor, picture: Tensor) -> tuple[Tensor, Tensor]:
        """g [N, 8C, h, w], picture [N, 1, h, w] -> hidden [N, 4C, 2h, 2w], picture [N, 1, 2h, 2w]."""
        return self.hidden(g), self.next_picture(picture)


def _gelu_chain(widths: Sequence[int]) -> list[nn.Module]:
    """Return the layers conv3, GELU, conv3, GELU, ..., conv3 of the given widths."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [conv(inputs, outputs, 3), nn.GELU()]
    return layers[:-1]
