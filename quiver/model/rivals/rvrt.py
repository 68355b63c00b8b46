"""Defines RVRT, the recurrent video restoration transformer (Liang et al., NeurIPS 2022).

    frames -> flow between neighbours, and shallow features, at a quarter of the size -> four passes over clips of two
    frames (backward, forward, backward, forward): align the clip before by guided deformable attention, refine by a
    transformer stack of all finished passes -> a stack of all passes -> four times the size -> plus the frames

Written from a description of the article and of its port to 3-bit frames; the names of the layers are the port's.
Look-ahead: the whole clip. An odd clip is made even by one reflected frame at its end, which is cut off again.

Our reading: frames are padded by repeating the edge to multiples of 4, and to 132 px, where six levels of flow need
them. Axes of at most 8 feature pixels are one unshifted window; the port never has them.

The transformer stacks have shifted windows in space, and all frames of a clip in one window. Their tensors are
[N, D, C, H, W] outside, N clips of D frames; inside a stack they are [N, D, H, W, C].
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from quiver.model.config import NetworkConfig, whole_number
from quiver.model.deformable import warp
from quiver.model.ops.deformable_attention import deformable_attention
from quiver.model.rivals.edges import check_frames, pad_space, reflected
from quiver.model.rivals.spynet import MULTIPLE, SpyNet

CLIP = 2  # frames of a clip
QUARTER = 4  # px of a frame per feature pixel and axis
BICUBIC = (-3 / 32, 19 / 32, 19 / 32, -3 / 32)  # weights of a block's pixels per axis; cubic with a = -0.75
PASSES = ("backward_1", "forward_1", "backward_2", "forward_2")
GROUPS = 12  # offset groups; the first half moves keys, the other values
ATTENTION_HEADS = 12  # of the deformable attention, which is twice as wide as the features
TAPS = 9
LARGEST_RESIDUE = 10.0  # px that an offset may differ from the flow
HIDDEN = 64  # channels of the offset network and of the layers at full size
SLOPE = 0.1  # of every LeakyReLU
HEADS = 6  # of the attention in a window
WINDOW = 8  # px, rows and columns of a window
SHIFT = 4  # px, of every second layer
OTHER_REGION = -100.0  # added to the logits of pixels that are neighbours only because the image was rolled


@dataclass(frozen=True)
class RVRTConfig(NetworkConfig):
    """Configuration of RVRT; the defaults are the published sizes."""

    width: int = 144  # channels, a multiple of 6
    flow_levels: int = 6  # of the flow network; with six, frames smaller than 132 px are padded to it

    def __post_init__(self) -> None:
        """Raise `ValueError` for a value out of range."""
        whole_number("RVRTConfig.width", self.width, HEADS, 1536)
        if self.width % HEADS:
            raise ValueError(
                f"RVRTConfig.width must be a multiple of {HEADS}, got {self.width}; "
                f"choose {self.width // HEADS * HEADS}"
            )
        whole_number("RVRTConfig.flow_levels", self.flow_levels, 1, 6)


class Guides(NamedTuple):
    """Flows [B, 2, 2, h, w] in px (x, y) from the two frames of a clip into the two of the clip visited before."""

    straight: Tensor  # from frame i into frame i; A of the article
    crossed: Tensor  # from frame i into frame 1 - i; B


class RVRT(nn.Module):
    """RVRT for grey frames."""

    look_ahead: ClassVar[int | None] = None  # all frames
    unused: ClassVar[tuple[str, ...]] = ()

    def __init__(self, config: RVRTConfig | None = None) -> None:
        """Make the network of a configuration; the published sizes by default."""
        super().__init__()
        self.config = config = config or RVRTConfig()
        width = config.width
        self.least = QUARTER * max(2**config.flow_levels - MULTIPLE + 1, 1)  # px; the coarsest level must have two
        self.spynet = SpyNet(config.flow_levels)
        self.feat_extract = nn.ModuleDict(
            {
                "1": FrameConv(1, width, 3, stride=2),
                "3": FrameConv(width, width, 3, stride=2),
                "6": SwinStack(width, width, blocks=1, frames=1),
            }
        )
        self.backbone = nn.ModuleDict(
            {name: SwinStack((2 + i) * width, width, blocks=2, frames=CLIP) for i, name in enumerate(PASSES)}
        )
        self.deform_align = nn.ModuleDict({name: Align(width) for name in PASSES})
        self.reconstruction = SwinStack((1 + len(PASSES)) * width, width, blocks=1, frames=1)
        self.conv_before_upsampler = nn.Sequential(FrameConv(width, HIDDEN, 1), nn.LeakyReLU(SLOPE))
        self.upsampler = nn.ModuleDict(
            {
                "0": FrameConv(HIDDEN, 4 * HIDDEN, 3),
                "5": FrameConv(HIDDEN, 4 * HIDDEN, 3),
                "10": FrameConv(HIDDEN, HIDDEN, 3),
            }
        )
        self.conv_last = FrameConv(HIDDEN, 1, 3)

    def forward(self, frames: Tensor) -> Tensor:
        """[B, T, 1, H, W] of codes/(2^b - 1) -> restored [B, T, 1, H, W]; ValueError for another shape."""
        check_frames(frames)
        count = frames.shape[1]
        height, width = frames.shape[-2:]
        even = frames[:, reflected(0, count + count % CLIP, count)]
        padded = pad_space(even, QUARTER, self.least)
        restored = padded + self.rebuilt(self.features(padded))
        return restored[:, :count, :, :height, :width]

    def features(self, frames: Tensor) -> dict[str, Tensor]:
        """[B, T, 1, H, W], T even -> features [B, T, C, H/4, W/4] by pass; the first are "shallow" ones."""
        batch = frames.shape[:2]
        shallow = self.shallow(frames.flatten(0, 1)).unflatten(0, batch)
        to_next, to_previous = self.flows(frames)
        features = {"shallow": shallow}
        guides: dict[str, list[Guides | None]] = {}
        for name in PASSES:
            direction, turn = name.split("_")
            given = guides[direction] if turn == "2" else None
            if direction == "forward":
                features[name], guides[direction] = self.passed(name, features, to_previous, given)
                continue
            seen = {key: feature.flip(1) for key, feature in features.items()}  # the last frame comes first
            found, guides[direction] = self.passed(name, seen, to_next.flip(1), given)
            features[name] = found.flip(1)
        return features

    def shallow(self, images: Tensor) -> Tensor:
        """[N, 1, H, W] -> [N, C, H/4, W/4]."""
        layers = self.feat_extract
        x = F.leaky_relu(layers["3"](F.leaky_relu(layers["1"](images), SLOPE)), SLOPE)
        return layers["6"](x.unsqueeze(1)).squeeze(1)

    def flows(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        """[B, T, 1, H, W] -> flows [B, T-1, 2, H/4, W/4] in px (x, y): on frame j into j+1, on frame j+1 into j."""
        small = reduced(frames.flatten(0, 1)).unflatten(0, frames.shape[:2])
        first = small[:, :-1].flatten(0, 1)
        second = small[:, 1:].flatten(0, 1)
        pairs = (frames.shape[0], frames.shape[1] - 1)
        return self.spynet(first, second).unflatten(0, pairs), self.spynet(second, first).unflatten(0, pairs)

    def passed(
        self, name: str, features: Mapping[str, Tensor], steps: Tensor, given: list[Guides | None] | None
    ) -> tuple[Tensor, list[Guides | None]]:
        """One pass over the features [B, T, C, h, w] of the finished passes, all in visiting order.

        Steps [B, T-1, 2, h, w] are flows on frame j+1 into frame j. Returns the features [B, T, C, h, w], and the
        corrected guides of every clip but the first; those `given` replace the flows composed of steps.
        """
        last = features[list(features)[-1]]  # of the pass before
        state = torch.zeros_like(last[:, :CLIP])
        states: list[Tensor] = []
        guides: list[Guides | None] = []
        for start in range(0, last.shape[1], CLIP):
            clip = slice(start, start + CLIP)
            corrected = None
            if start:
                guide = composed(steps[:, start - CLIP : start + 1]) if given is None else given[len(guides)]
                assert guide is not None
                state, corrected = self.deform_align[name](last[:, clip], last[:, start - CLIP : start], state, guide)
            inputs = torch.cat([*(feature[:, clip] for feature in features.values()), state], dim=2)
            state = state + self.backbone[name](inputs)
            states.append(state)
            guides.append(corrected)
        return torch.cat(states, dim=1), guides

    def rebuilt(self, features: Mapping[str, Tensor]) -> Tensor:
        """Features [B, T, C, h, w] of all passes -> what the frames lack [B, T, 1, 4h, 4w]; frame by frame."""
        frames = zip(*(feature.unbind(1) for feature in features.values()), strict=True)
        return torch.stack([self.enlarged(torch.cat(parts, dim=1)) for parts in frames], dim=1)

    def enlarged(self, x: Tensor) -> Tensor:
        """Features [N, 5C, h, w] of one frame -> [N, 1, 4h, 4w]."""
        x = self.conv_before_upsampler(self.reconstruction(x.unsqueeze(1)).squeeze(1))
        for place in ("0", "5"):
            x = F.leaky_relu(F.pixel_shuffle(self.upsampler[place](x), 2), SLOPE)
        return self.conv_last(self.upsampler["10"](x))


class Align(nn.Module):
    """Guided deformable attention: a clip looks into the one before at places that flow and a network choose."""

    def __init__(self, width: int) -> None:
        """Make the layers; the offset network begins with no correction of the flow."""
        super().__init__()
        self.proj_q, self.proj_k, self.proj_v = (nn.ModuleDict({"1": nn.Linear(width, 2 * width)}) for _ in range(3))
        self.mlp = nn.ModuleDict({"1": MLP(width)})
        layers: list[nn.Module] = [FrameConv(3 * width + 4, HIDDEN, 1)]
        for _ in range(4):
            layers += [nn.LeakyReLU(SLOPE), FrameConv(HIDDEN, HIDDEN, 3)]
        last = FrameConv(HIDDEN, 2 * GROUPS * TAPS * 2, 1)
        for parameter in last.parameters():
            nn.init.zeros_(parameter)
        self.conv_offset = nn.Sequential(*layers, nn.LeakyReLU(SLOPE), last)
        self.proj = nn.ModuleDict({"1": nn.Linear(2 * width, width)})

    def forward(self, query: Tensor, key: Tensor, value: Tensor, guides: Guides) -> tuple[Tensor, Guides]:
        """Query of this clip, key and value of the one before [B, 2, C, h, w] -> (result [B, 2, C, h, w], guides).

        The guides returned are the means of the corrected ones over offset groups and taps.
        """
        flows = torch.stack(guides, dim=2)  # [B, frame, source, 2, h, w]
        offset = self.offsets(query, value, guides) + flows.flip(3)[:, :, :, None, None]
        corrected = Guides(*offset.mean(dim=(3, 4)).flip(3).unbind(2))
        keys, values = (_linear(part["1"], x) for part, x in ((self.proj_k, key), (self.proj_v, value)))
        keys, values = (torch.stack([x, x.flip(1)], dim=2).flatten(0, 1) for x in (keys, values))
        queries = _linear(self.proj_q["1"], query).flatten(0, 1)
        found = deformable_attention(queries, keys, values, offset.flatten(0, 1), ATTENTION_HEADS)
        result = self.proj["1"](found.unflatten(0, query.shape[:2]).movedim(2, -1))
        return (result + self.mlp["1"](result)).movedim(-1, 2), corrected

    def offsets(self, query: Tensor, value: Tensor, guides: Guides) -> Tensor:
        """Return the corrections [B, frame, source, groups, taps, 2, h, w] of the guides in px, (dy, dx)."""
        warped = [
            warp(frames.flatten(0, 1), flow.flatten(0, 1))
            for frames, flow in ((value, guides.straight), (value.flip(1), guides.crossed))
        ]
        seen = torch.cat([query.flatten(0, 1), *warped, *(flow.flatten(0, 1) for flow in guides)], dim=1)
        raw = self.conv_offset(seen)
        return LARGEST_RESIDUE * raw.tanh().view(*query.shape[:2], len(guides), GROUPS, TAPS, 2, *query.shape[3:])


def reduced(images: Tensor) -> Tensor:
    """[N, 1, H, W] -> a quarter of the size [N, 1, H/4, W/4]; bicubic, each pixel from its own block alone."""
    weights = images.new_tensor(BICUBIC)
    return F.conv2d(images, (weights[:, None] * weights)[None, None], stride=QUARTER)


def composed(steps: Tensor) -> Guides:
    """Flows [B, 3, 2, h, w] between neighbours of four frames, on j+1 into j -> guides of frames 2, 3 into 0, 1."""
    f10, f21, f32 = steps.unbind(1)
    # Flows are composed: from frame 2 to frame 1, and from where that ends on to frame 0.
    f20 = f21 + warp(f10, f21)
    f31 = f32 + warp(f21, f32)
    f30 = f32 + warp(f20, f32)
    return Guides(torch.stack([f20, f31], dim=1), torch.stack([f21, f30], dim=1))


def _linear(layer: nn.Module, x: Tensor) -> Tensor:
    """Apply a layer to the channels: [B, D, C, h, w] -> [B, D, C', h, w]."""
    return layer(x.movedim(2, -1)).movedim(-1, 2)


# ---- Transformer stacks


class FrameConv(nn.Module):
    """A convolution of every frame alone; its weight has a time axis of length 1, as published."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int = 1) -> None:
        """Begin with the weights of an ordinary convolution."""
        super().__init__()
        plain = nn.Conv2d(inputs, outputs, kernel)
        self.weight = nn.Parameter(plain.weight.data.unsqueeze(2))
        self.bias = plain.bias
        self.stride = stride

    def forward(self, x: Tensor) -> Tensor:
        """[N, inputs, H, W] -> [N, outputs, H, W], sides divided by the stride."""
        return F.conv2d(x, self.weight.squeeze(2), self.bias, self.stride, padding=self.weight.shape[-1] // 2)


class MLP(nn.Module):
    """Two linear layers with GELU between, twice as wide inside."""

    def __init__(self, width: int) -> None:
        """Make the layers."""
        super().__init__()
        self.fc1 = nn.Linear(width, 2 * width)
        self.fc2 = nn.Linear(2 * width, width)

    def forward(self, x: Tensor) -> Tensor:
        """[..., C] -> [..., C]."""
        return self.fc2(F.gelu(self.fc1(x)))


class WindowAttention(nn.Module):
    """Attention among the pixels of each window, with a learnt bias per relative position."""

    def __init__(self, width: int, frames: int) -> None:
        """Make the layers; a window has that many frames."""
        super().__init__()
        self.frames = frames
        side = 2 * WINDOW - 1
        self.relative_position_bias_table = nn.Parameter(torch.zeros((2 * frames - 1) * side**2, HEADS))
        self.register_buffer("relative_position_index", relative_positions(frames))
        self.relative_position_index: Tensor
        self.qkv_self = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)

    def forward(self, x: Tensor, window: tuple[int, int], regions: Tensor | None) -> Tensor:
        """Windows [N, M, n, C] of n = frames * h * w pixels, window = (h, w) <= 8 px -> [N, M, n, C].

        Regions [M, n] are numbers; pixels of different regions hardly see each other.
        """
        q, k, v = self.qkv_self(x).unflatten(-1, (3, HEADS, -1)).movedim(-3, 0).transpose(-2, -3)
        bias = self.bias(window).unsqueeze(0)
        if regions is not None:
            apart = regions[:, None, :, None] != regions[:, None, None, :]
            bias = bias + apart.to(bias.dtype) * OTHER_REGION
        attended = F.scaled_dot_product_attention(q, k, v, attn_mask=bias.to(q.dtype))
        return self.proj(attended.transpose(-2, -3).flatten(-2))

    def bias(self, window: tuple[int, int]) -> Tensor:
        """Return the bias [heads, n, n] of query and key in a window of that many rows and columns."""
        height, width = window
        index = self.relative_position_index.view(2 * (self.frames, WINDOW, WINDOW))
        index = index[:, :height, :width, :, :height, :width].reshape(2 * (self.frames * height * width,))
        return self.relative_position_bias_table[index].permute(2, 0, 1)


class SwinLayer(nn.Module):
    """Window attention, then a network per pixel, each after a normalisation and with a residual."""

    def __init__(self, width: int, frames: int, *, shifted: bool) -> None:
        """Make the layers; a shifted layer rolls the image by half a window."""
        super().__init__()
        self.shifted = shifted
        self.norm1 = nn.LayerNorm(width)
        self.attn = WindowAttention(width, frames)
        self.norm2 = nn.LayerNorm(width)
        self.mlp = MLP(width)

    def forward(self, x: Tensor) -> Tensor:
        """[N, D, H, W, C] -> the same; D is the window's number of frames."""
        x = x + self.attended(self.norm1(x))
        return x + self.mlp(self.norm2(x))

    def attended(self, x: Tensor) -> Tensor:
        """[N, D, H, W, C] -> the same, by attention in windows.

        An axis no longer than a window is one window, unshifted. Others are padded with zeros to whole windows; the
        padded positions take part as keys and values.
        """
        count, frames, height, width, channels = x.shape
        window = min(WINDOW, height), min(WINDOW, width)
        shift = [SHIFT if self.shifted and side > WINDOW else 0 for side in (height, width)]
        x = F.pad(x, (0, 0, 0, -width % window[1], 0, -height % window[0])).roll((-shift[0], -shift[1]), (2, 3))
        rows = x.shape[2] // window[0]
        columns = x.shape[3] // window[1]
        cut = x.view(count, frames, rows, window[0], columns, window[1], channels).permute(0, 2, 4, 1, 3, 5, 6)
        # Rolling brings opposite edges of the image into one window; their
        # pixels must not see each other (Swin, Liu et al. 2021).
        regions = _regions(cut.shape[1:6], shift, x.device) if any(shift) else None
        done = self.attn(cut.reshape(count, rows * columns, -1, channels), window, regions)
        joined = done.view(cut.shape).permute(0, 3, 1, 4, 2, 5, 6).reshape(x.shape)
        return joined.roll((shift[0], shift[1]), (2, 3))[:, :, :height, :width]


class SwinBlock(nn.Module):
    """Two Swin layers, the second one shifted, and a linear layer, with a residual."""

    def __init__(self, width: int, frames: int) -> None:
        """Make the layers."""
        super().__init__()
        layers = nn.ModuleList(SwinLayer(width, frames, shifted=shifted) for shifted in (False, True))
        self.residual_group = nn.ModuleDict({"blocks": layers})
        self.linear = nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """[N, D, H, W, C] -> the same."""
        unshifted, shifted = self.residual_group["blocks"].children()
        return x + self.linear(shifted(unshifted(x)))


class SwinStack(nn.Module):
    """A convolution per frame, a normalisation, blocks, a normalisation."""

    def __init__(self, inputs: int, width: int, blocks: int, frames: int) -> None:
        """Make the layers, at their published places."""
        super().__init__()
        self.main = nn.ModuleDict(
            {
                "1": FrameConv(inputs, width, 3),
                "3": nn.LayerNorm(width),
                "5": nn.Sequential(*(SwinBlock(width, frames) for _ in range(blocks))),
                "7": nn.LayerNorm(width),
            }
        )

    def forward(self, x: Tensor) -> Tensor:
        """[N, D, inputs, H, W] -> [N, D, C, H, W]; D is the number of frames of a window."""
        x = self.main["1"](x.flatten(0, 1)).unflatten(0, x.shape[:2]).movedim(2, -1)
        return self.main["7"](self.main["5"](self.main["3"](x))).movedim(-1, 2)


def relative_positions(frames: int) -> Tensor:
    """Return rows [n, n] of the bias table for query and key, n = frames * 64 pixels in order (time, row, column)."""
    places = np.indices((frames, WINDOW, WINDOW)).reshape(3, -1).T
    difference = places[:, None] - places[None, :] + np.array([frames - 1, WINDOW - 1, WINDOW - 1])
    side = 2 * WINDOW - 1
    return torch.from_numpy((difference[..., 0] * side + difference[..., 1]) * side + difference[..., 2])


def _regions(shape: torch.Size, shift: list[int], device: torch.device) -> Tensor:
    """Number the regions of a rolled image, cut as (rows, columns, frames, h, w) windows -> [windows, pixels]."""
    rows, columns, frames, height, width = shape
    labels = []
    for count, side, by in ((rows, height, shift[0]), (columns, width, shift[1])):
        places = torch.arange(count * side, device=device)
        last = count * side - side  # where the last window begins; the wrapped part begins half a window later
        labels.append((places >= last).long() + (places >= last + by).long() if by else torch.zeros_like(places))
    numbers = (3 * labels[0][:, None] + labels[1]).view(rows, 1, height, columns, 1, width)
    numbers = numbers.permute(0, 3, 1, 4, 2, 5).expand(-1, -1, frames, -1, -1, -1)
    return numbers.reshape(rows * columns, frames * height * width)
