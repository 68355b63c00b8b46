"""Defines RVRT, the recurrent video restoration transformer (Liang et al., NeurIPS 2022).

    frames -> flow between neighbours, and shallow features, at a quarter of the size -> four passes over clips of two
    frames (backward, forward, backward, forward): align the clip before by guided deformable attention, refine by a
    transformer stack of all finished passes -> a stack of all passes -> four times the size -> plus the frames

Written from a description of the article and of its port to 3-bit frames; the names of the layers are the port's.
Look-ahead: the whole clip. An odd clip is made even by one reflected frame at its end, which is cut off again.

Our reading: frames are padded by repeating the edge to multiples of 4, and to 132 px, where six levels of flow need
them. Axes of at most 8 feature pixels are one unshifted window; the port never has them.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import ClassVar, NamedTuple, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from qsim.records import convert
from quiver.model.config import whole_number
from quiver.model.deformable import warp
from quiver.model.ops.deformable_attention import deformable_attention
from quiver.model.rivals.edges import check_frames, pad_space, reflected
from quiver.model.rivals.rvrt_swin import HEADS, MLP, FrameConv, SwinStack
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


@dataclass(frozen=True)
class RVRTConfig:
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

    def to_dict(self) -> dict[str, object]:
        """Return plain values for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, object]) -> Self:
        """Return the configuration of such values; ValueError for unknown fields and values out of range."""
        return convert(values, cls, "RVRT")


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
        count, (height, width) = frames.shape[1], frames.shape[-2:]
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
    f20 = f21 + warp(f10, f21)
    f31 = f32 + warp(f21, f32)
    f30 = f32 + warp(f20, f32)
    return Guides(torch.stack([f20, f31], dim=1), torch.stack([f21, f30], dim=1))


def _linear(layer: nn.Module, x: Tensor) -> Tensor:
    """Apply a layer to the channels: [B, D, C, h, w] -> [B, D, C', h, w]."""
    return layer(x.movedim(2, -1)).movedim(-1, 2)
