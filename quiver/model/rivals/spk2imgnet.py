"""Defines Spk2ImgNet (Zhao et al., CVPR 2021), made for spike cameras: five groups of frames, aligned and fused.

    groups of frames -> light estimates, weighted, features (shared) -> pyramids of three levels -> four groups are
    aligned to the middle one by deformable convolutions, coarse to fine, then once more -> gates -> fusion

Written from a description of the article and of its port to 3-bit frames; the names of the layers are the port's.
To restore frame t the port reads ten frames, t-5 ... t+4, as five disjoint pairs. Look-ahead: 4 frames; 5 with groups
of three. Beyond the ends of a clip, time runs backwards. Neighbouring results share groups: features are computed once.

The port trains output/0.6, the constant of a spike converter, against the target, and scores the output without it: its
images are 0.6 times too dark. Here both are divided by 0.6; `as_published` brings the missing factor back.

Our reading: `group_frames=3` makes groups that overlap by one frame, whose middles are t-4, t-2 ... t+4. The middle of
the clip is then the restored frame, and the factor is left out. Where the port has 16 channels, we have width/4.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from quiver.model.config import NetworkConfig, flag, whole_number
from quiver.model.deformable import deform_conv2d
from quiver.model.rivals.edges import restored_range

GROUPS = 5  # of frames, two frames apart
BEFORE = 5  # frames of a window before the restored one
MIDDLE = 2  # the group to which the others are aligned
BRANCHES = 4  # light estimates
DEFORMABLE_GROUPS = 8
CONVERTER = 0.6  # what the network gives for a target of 1


@dataclass(frozen=True)
class Spk2ImgNetConfig(NetworkConfig):
    """Configuration of Spk2ImgNet; the defaults are the published sizes with the factor that the port forgot."""

    width: int = 64  # channels of the features
    blocks: int = 10  # of the extractor
    group_frames: int = 2  # ours: 3 makes groups overlap, with the restored frame in the middle
    as_published: bool = False  # the factor is missing

    def __post_init__(self) -> None:
        """Raise `ValueError` for a value out of range."""
        whole_number("Spk2ImgNetConfig.width", self.width, 8, 1024)
        whole_number("Spk2ImgNetConfig.blocks", self.blocks, 1, 100)
        whole_number("Spk2ImgNetConfig.group_frames", self.group_frames, 2, 3)
        flag("Spk2ImgNetConfig.as_published", self.as_published)
        if self.width % DEFORMABLE_GROUPS:
            raise ValueError(f"Spk2ImgNetConfig.width must be a multiple of {DEFORMABLE_GROUPS}, got {self.width}")
        if self.as_published and self.group_frames != 2:
            raise ValueError(
                f"Spk2ImgNetConfig.as_published needs groups of 2 frames, got {self.group_frames}; "
                "leave one of the two settings out"
            )


class Extracted(NamedTuple):
    """What the extractor finds in a group of frames."""

    features: Tensor  # [N, width, H, W]
    estimates: Tensor  # [N, 4, H, W] light estimates, one per branch


class Spk2ImgNet(nn.Module):
    """Spk2ImgNet: a window of ten or eleven frames gives one restored frame."""

    multiple: ClassVar[int] = 4  # px that divide height and width inside
    unused: ClassVar[tuple[str, ...]] = ()

    def __init__(self, config: Spk2ImgNetConfig | None = None) -> None:
        """Make the network of a configuration; the published sizes by default."""
        super().__init__()
        self.config = config = config or Spk2ImgNetConfig()
        width = config.width
        self.frames_in = 2 * (GROUPS - 1) + config.group_frames
        self.look_ahead = self.frames_in - BEFORE - 1  # frames
        # The published network gives 0.6 for a target of 1; its port forgot to divide by that.
        self.unit = 1.0 if config.as_published or config.group_frames == 3 else CONVERTER
        self.extractor = Extractor(config)
        self.mask0, self.mask1, self.mask3, self.mask4 = (Gate(width) for _ in range(GROUPS - 1))
        self.rec_conv0 = _conv(GROUPS * width, 3 * width)
        self.rec_conv1 = _conv(3 * width, width)
        self.rec_conv2 = _conv(width, 1)
        self.pcd_align = PyramidAlignment(width)

    def forward(self, frames: Tensor) -> Tensor:
        """[B, T, 1, H, W] of codes/(2^b - 1) -> restored [B, T, 1, H, W]; ValueError for another shape."""
        return restored_range(self, frames, 0, frames.shape[1])

    def windows(self, frames: Tensor) -> Tensor:
        """[B, T, 1, H, W], T >= frames_in, H and W multiples of 4 -> restored frames [B, T - frames_in + 1, 1, H, W].

        The first is frame 5. Pyramids of groups are computed once.
        """
        pyramids: dict[int, list[Tensor]] = {}  # by the first frame of the group
        restored = []
        for t in range(frames.shape[1] - self.frames_in + 1):
            starts = [t + 2 * j for j in range(GROUPS)]
            pyramids = {start: pyramids[start] for start in pyramids if start >= starts[0]}
            for start in starts:
                if start not in pyramids:
                    group = frames[:, start : start + self.config.group_frames, 0]
                    pyramids[start] = self.pcd_align.levels(self.extractor(group).features)
            restored.append(self.fuse([pyramids[start] for start in starts]) / self.unit)
        return torch.stack(restored, dim=1)

    def window(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        """Window [N, 10 or 11, H, W] of codes/(2^b - 1) -> (restored frame 5 [N, 1, H, W], estimates [N, 5, 4, H, W]).

        Height and width must be multiples of 4. The estimates of group j are those of frame 2j + 1, in the same units.
        """
        starts = range(0, 2 * GROUPS, 2)
        groups = [self.extractor(frames[:, start : start + self.config.group_frames]) for start in starts]
        restored = self.fuse([self.pcd_align.levels(group.features) for group in groups])
        estimates = torch.stack([group.estimates for group in groups], dim=1)
        return restored / self.unit, estimates / self.unit

    def fuse(self, pyramids: Sequence[list[Tensor]]) -> Tensor:
        """Pyramids of the five groups -> the frame [N, 1, H, W], still in the units of the network."""
        middle = pyramids[MIDDLE]
        gates = (self.mask0, self.mask1, None, self.mask3, self.mask4)
        parts = []
        for pyramid, gate in zip(pyramids, gates, strict=True):
            if gate is None:
                parts.append(middle[0])
                continue
            aligned = self.pcd_align(pyramid, middle)
            # Alignment errs where bodies hide each other; there the gate closes.
            parts.append(gate(aligned, middle[0]) * aligned)
        x = F.relu(self.rec_conv0(torch.cat(parts, dim=1)))
        return self.rec_conv2(F.relu(self.rec_conv1(x)))


class Extractor(nn.ModuleDict):
    """Finds features of a group of frames, by way of four weighted estimates of the light."""

    def __init__(self, config: Spk2ImgNetConfig) -> None:
        """Make the layers."""
        frames = config.group_frames
        width = config.width
        first = {f"conv0_{branch}": _conv(frames, width // 4) for branch in range(BRANCHES)}
        second = {f"conv1_{branch}": _conv(width // 4, 1) for branch in range(BRANCHES)}
        net = nn.Sequential(*(Block(width) for _ in range(config.blocks)))
        super().__init__({**first, **second, "ca": Weights(), "conv": _conv(BRANCHES, width), "net": net})

    def forward(self, frames: Tensor) -> Extracted:
        """Group [N, 2 or 3, H, W] -> features and estimates."""
        hidden = (F.relu(self[f"conv0_{branch}"](frames)) for branch in range(BRANCHES))
        estimates = torch.cat([self[f"conv1_{branch}"](x) for branch, x in enumerate(hidden)], dim=1)
        shallow = F.relu(self["conv"](self["ca"](estimates) * estimates))
        return Extracted(self["net"](shallow) + shallow, estimates)


class Weights(nn.Module):
    """Weights of the light estimates, at every pixel."""

    def __init__(self) -> None:
        """Make the layers."""
        super().__init__()
        layers = [_conv(BRANCHES, 2 * BRANCHES), nn.ReLU(), _conv(2 * BRANCHES, BRANCHES), nn.Sigmoid()]
        self.ca_block = nn.Sequential(*layers)

    def forward(self, estimates: Tensor) -> Tensor:
        """Estimates [N, 4, H, W] -> weights [N, 4, H, W], 0 ... 1."""
        return self.ca_block(estimates)


class Block(nn.Module):
    """A residual block of three convolutions, with a ReLU after the sum."""

    def __init__(self, width: int) -> None:
        """Make the layers."""
        super().__init__()
        self.conv1, self.conv2, self.conv3 = (_conv(width, width) for _ in range(3))

    def forward(self, x: Tensor) -> Tensor:
        """[N, width, H, W] -> [N, width, H, W]."""
        return F.relu(x + self.conv3(F.relu(self.conv2(F.relu(self.conv1(x))))))


class Gate(nn.Module):
    """Weights of aligned features, from these and those of the middle."""

    def __init__(self, width: int) -> None:
        """Make the layers."""
        super().__init__()
        self.conv0 = _conv(2 * width, width)
        self.conv1 = _conv(width, width)
        self.conv2 = _conv(width, width)
        self.prelu0 = nn.PReLU()
        self.prelu1 = nn.PReLU()

    def forward(self, aligned: Tensor, middle: Tensor) -> Tensor:
        """Features [N, width, H, W], twice -> weights [N, width, H, W], 0 ... 1."""
        x = self.prelu0(self.conv0(torch.cat([aligned, middle], dim=1)))
        return torch.sigmoid(self.conv2(self.prelu1(self.conv1(x))))


class PyramidAlignment(nn.ModuleDict):
    """Makes pyramids of features and aligns one to another."""

    def __init__(self, width: int) -> None:
        """Make the layers."""
        layers: dict[str, nn.Module] = {}
        for level in (2, 3):
            layers[f"fea_L{level}_conv1"] = _conv(width, width, stride=2)
            layers[f"fea_L{level}_conv2"] = _conv(width, width)
        super().__init__({**layers, "pcd_align": Alignment(width)})

    def levels(self, features: Tensor) -> list[Tensor]:
        """Features [N, width, H, W] -> those, and features at half and at a quarter of the size."""
        result = [features]
        for level in (2, 3):
            halved = _leaky(self[f"fea_L{level}_conv1"](result[-1]))
            result.append(_leaky(self[f"fea_L{level}_conv2"](halved)))
        return result

    def forward(self, neighbour: Sequence[Tensor], middle: Sequence[Tensor]) -> Tensor:
        """Two pyramids -> the finest features of the first one [N, width, H, W], aligned to the second."""
        return self["pcd_align"](neighbour, middle)


class Alignment(nn.ModuleDict):
    """Deformable convolutions from the coarsest level to the finest, and one more there (the cascade)."""

    def __init__(self, width: int) -> None:
        """Make the layers."""
        layers: dict[str, nn.Module] = {}
        for level in (3, 2, 1):
            layers[f"L{level}_offset_conv1_1"] = _conv(2 * width, width)
            layers[f"L{level}_offset_conv2_1"] = _conv(width if level == 3 else 2 * width, width)
            if level < 3:
                layers[f"L{level}_offset_conv3_1"] = _conv(width, width)
            layers[f"L{level}_dcnpack_1"] = DeformableConvolution(width)
            if level < 3:
                layers[f"L{level}_fea_conv_1"] = _conv(2 * width, width)
        layers["cas_offset_conv1"] = _conv(2 * width, width)
        layers["cas_offset_conv2"] = _conv(width, width)
        layers["cas_dcnpack"] = DeformableConvolution(width)
        super().__init__(layers)

    def forward(self, neighbour: Sequence[Tensor], middle: Sequence[Tensor]) -> Tensor:
        """Two pyramids, finest level first -> the finest features of the first one, aligned [N, width, H, W]."""
        motion = self.motion(3, neighbour[2], middle[2], None)
        aligned = _leaky(self["L3_dcnpack_1"](neighbour[2], motion))
        for level in (2, 1):
            features = neighbour[level - 1]
            motion = self.motion(level, features, middle[level - 1], motion)
            moved = self[f"L{level}_dcnpack_1"](features, motion)
            aligned = self[f"L{level}_fea_conv_1"](torch.cat([moved, _doubled(aligned)], dim=1))
            if level == 2:
                aligned = _leaky(aligned)
        motion = _leaky(self["cas_offset_conv1"](torch.cat([aligned, middle[0]], dim=1)))
        motion = _leaky(self["cas_offset_conv2"](motion))
        return _leaky(self["cas_dcnpack"](aligned, motion))

    def motion(self, level: int, neighbour: Tensor, middle: Tensor, coarser: Tensor | None) -> Tensor:
        """Features [N, width, h, w], twice, and the coarser result [N, width, h/2, w/2] -> [N, width, h, w]."""
        x = _leaky(self[f"L{level}_offset_conv1_1"](torch.cat([neighbour, middle], dim=1)))
        if coarser is None:
            return _leaky(self[f"L{level}_offset_conv2_1"](x))
        x = torch.cat([x, 2 * _doubled(coarser)], dim=1)  # a shift has twice as many pixels at twice the size
        return _leaky(self[f"L{level}_offset_conv3_1"](_leaky(self[f"L{level}_offset_conv2_1"](x))))


class DeformableConvolution(nn.Module):
    """A 3 x 3 convolution at moved positions; features of the motion give its offsets and factors."""

    def __init__(self, width: int) -> None:
        """Begin without offsets, with all factors 1/2."""
        super().__init__()
        limit = (9 * width) ** -0.5
        self.weight = nn.Parameter(torch.empty(width, width, 3, 3).uniform_(-limit, limit))
        self.bias = nn.Parameter(torch.zeros(width))
        self.conv_offset_mask = _conv(width, 27 * DEFORMABLE_GROUPS)
        nn.init.zeros_(self.conv_offset_mask.weight)
        assert self.conv_offset_mask.bias is not None
        nn.init.zeros_(self.conv_offset_mask.bias)

    def forward(self, features: Tensor, motion: Tensor) -> Tensor:
        """Features and features of the motion [N, width, h, w] -> [N, width, h, w]."""
        offset, mask = self.conv_offset_mask(motion).split([18 * DEFORMABLE_GROUPS, 9 * DEFORMABLE_GROUPS], dim=1)
        moved = deform_conv2d(features, offset, self.weight, self.bias, torch.sigmoid(mask), padding=1)
        return moved.to(features.dtype)


def _conv(inputs: int, outputs: int, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, stride, padding=1)


def _leaky(x: Tensor) -> Tensor:
    return F.leaky_relu(x, 0.1)


def _doubled(x: Tensor) -> Tensor:
    return F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
