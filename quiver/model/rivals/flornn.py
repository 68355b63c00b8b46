"""Defines FloRNN, video denoising with look-ahead recurrence along a flow (Li et al., ECCV 2022).

    look-ahead net: runs over the frames in time order, k frames ahead of the output; before each frame its state is
                    splatted forward along the flow. The splatted states of the last k frames are kept.
    output net:     the same at the output frame; its state is warped backward along the flow
    output:         the look-ahead state is warped back through the k kept flows; the decoder takes both states

Written from a description of the article and of its port to 3-bit frames; the names of the layers are the port's, which
calls the look-ahead net `backward_rnn`.
Look-ahead: k frames, 9 in the port. Frames after the last are a reflection of the clip in time; the first frame has no
past. A clip of one frame has zero flow.

Our reading:

- The port uses a frozen flow network that was trained elsewhere. Here the flow is an argument, or estimated from the
  noisy frames by the flow network of QUIVER (`flow_channels`; entries `flow.*`), which is trained in place: it gets
  gradients through splatting and warping. `flows` returns its result for a separate loss.
- The port tells the network that there is no noise (`as_published`). By default the noise map is the sensor's deviation
  at the mean of 5 x 5 pixels.
- The three output channels share one target, so their mean is the restored frame.
- A frame with a side below 10 pixels is extended to 10, so that the ring around the states is not empty.
"""

from collections import deque
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from quiver.model.blocks import FlowNetwork
from quiver.model.config import FLOW_LAYERS, NetworkConfig, flag, real_number, whole_number
from quiver.model.deformable import warp
from quiver.model.ops.splatting import average_splat
from quiver.model.rivals.edges import check_frames, pad_space, reflected
from quiver.model.rivals.noise import deviation_map, table_of

LEAST_SIDE = 10  # px
VALID = 0.9999  # least part of a warped pixel that must come from inside


@dataclass(frozen=True)
class FloRNNConfig(NetworkConfig):
    """Configuration of FloRNN; the defaults are the published sizes, with a flow network and the sensor's noise."""

    width: int = 64  # channels of a state
    blocks: int = 15  # residual blocks of each recurrent net
    look_ahead: int = 9  # frames
    image_channels: int = 3  # copies of the grey frame
    border: float = 0.1  # ring around the states, as a part of each side
    flow_channels: tuple[int, ...] = (32, 64, 32, 16)  # of the flow network; none: the flow must be given
    flow_kernel: int = 7
    flow_levels: int = 4
    as_published: bool = False  # noise map zero

    def __post_init__(self) -> None:
        """Raise `ValueError` for a value out of range."""
        for name, most in (("width", 1024), ("blocks", 100), ("look_ahead", 1000), ("image_channels", 64)):
            whole_number(f"FloRNNConfig.{name}", getattr(self, name), 1, most)
        real_number("FloRNNConfig.border", self.border, 0, 1)
        whole_number("FloRNNConfig.flow_levels", self.flow_levels, 3, 8)
        whole_number("FloRNNConfig.flow_kernel", self.flow_kernel, 1, 15)
        if not self.flow_kernel % 2:
            raise ValueError(f"FloRNNConfig.flow_kernel must be odd, got {self.flow_kernel}")
        if not isinstance(self.flow_channels, list | tuple) or len(self.flow_channels) > FLOW_LAYERS:
            raise ValueError(
                f"FloRNNConfig.flow_channels must be a list of at most {FLOW_LAYERS} widths; give [] for a flow that "
                "is given"
            )
        for channels in self.flow_channels:
            whole_number("FloRNNConfig.flow_channels", channels, 1, 1024)
        object.__setattr__(self, "flow_channels", tuple(self.flow_channels))
        flag("FloRNNConfig.as_published", self.as_published)


class Flows(NamedTuple):
    """Flows in pixels, channel 0 = x (right), 1 = y (down)."""

    forward: Tensor  # [B, n, 2, H, W]: flow i from frame i to frame i+1, on the grid of frame i
    backward: Tensor  # [B, m, 2, H, W]: flow i from frame i+1 to frame i, on the grid of frame i+1


class FloRNN(nn.Module):
    """FloRNN for grey frames."""

    unused: ClassVar[tuple[str, ...]] = ("pwcnet.",)  # the port's frozen flow network

    def __init__(self, config: FloRNNConfig | None = None) -> None:
        """Make the network of a configuration; the published sizes by default."""
        super().__init__()
        self.config = config = config or FloRNNConfig()
        self.look_ahead = config.look_ahead  # frames
        self.forward_rnn = RecurrentNet(config)
        self.backward_rnn = RecurrentNet(config)
        self.d = Decoder(config)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight)
                module.weight.data.clamp_(-1, 1).mul_(0.2)
        self.flow = (
            FlowNetwork(config.flow_channels, config.flow_kernel, config.flow_levels) if config.flow_channels else None
        )
        self.takes_variance = not config.as_published

    def forward(self, frames: Tensor, flows: Flows | None = None, variance: Tensor | None = None) -> Tensor:
        """[B, T, 1, H, W] of codes/(2^b - 1) -> restored [B, T, 1, H, W]; ValueError for another shape.

        `flows` (default: estimated) has T-1 flows forward and T-1 backward at [H, W]. `variance` is the sensor's table,
        [n] or one per clip [B, n]; None: that of noise.VARIANCE.
        """
        check_frames(frames)
        batch, count, _, height, width = frames.shape
        frames = pad_space(frames, 1, LEAST_SIDE)
        if flows is None:
            flows = self.flows(frames)
        else:
            needed = (batch, count - 1, 2, height, width)
            if any(flow.shape != needed for flow in flows):
                found = " and ".join(str(tuple(flow.shape)) for flow in flows)
                raise ValueError(f"flows must be {needed} forward and backward, got {found}; give one per pair")
            flows = Flows(*(pad_space(flow, 1, LEAST_SIDE) for flow in flows)) if count > 1 else self.flows(frames)
        order = reflected(0, count + self.look_ahead, count)
        images = frames[:, order].expand(-1, -1, self.config.image_channels, -1, -1)
        noise = self.noise(frames, variance)[:, order]
        restored = self.restore(images, noise, reflected_flows(flows, self.look_ahead))
        return restored.mean(dim=2, keepdim=True)[..., :height, :width]

    def flows(self, frames: Tensor) -> Flows:
        """Frames [B, T, 1, H, W] -> estimated flows between neighbours, T-1 forward and T-1 backward [B, T-1, 2, H, W].

        ValueError without a flow network, unless there is but one frame.
        """
        batch, count, _, height, width = frames.shape
        if count == 1:
            return Flows(*2 * (frames.new_zeros(batch, 0, 2, height, width),))
        if self.flow is None:
            raise ValueError("this FloRNN has no flow network; give the flows, or set FloRNNConfig.flow_channels")
        earlier = frames[:, :-1].flatten(0, 1)
        later = frames[:, 1:].flatten(0, 1)
        pairs = len(earlier) if torch.is_grad_enabled() else 1  # at a time: the pyramids of all take gigabytes
        parts = []
        for i in range(0, len(earlier), pairs):
            a = earlier[i : i + pairs]
            b = later[i : i + pairs]
            parts.append(self.flow(torch.cat([a, b]), torch.cat([b, a]))[0].unflatten(0, (2, len(a))))
        return Flows(*(flow.unflatten(0, (batch, count - 1)) for flow in torch.cat(parts, dim=1)))

    def noise(self, frames: Tensor, variance: Tensor | None = None) -> Tensor:
        """Frames [B, T, 1, H, W] -> noise maps of the same shape: the deviation of each pixel, or 0 if as published."""
        if self.config.as_published:
            return torch.zeros_like(frames)
        return deviation_map(frames, table_of(variance, frames))

    def restore(self, images: Tensor, noise: Tensor, flows: Flows) -> Tensor:
        """Images [B, N, C, H, W] and noise maps [B, N, 1, H, W] -> restored images 0 ... N-k-1 [B, N-k, C, H, W].

        Nothing is padded or reflected. Of the flows, N-1 forward ones and N-k-1 backward ones are used.
        """
        maps = noise.expand_as(images)
        ahead = self.backward_rnn(images[:, 0], maps[:, 0])
        state = self.forward_rnn(images[:, 0], maps[:, 0])
        kept: deque[tuple[Tensor, Tensor]] = deque(maxlen=self.look_ahead)
        restored = []
        for i in range(1, images.shape[1]):
            flow = self.ringed(flows.forward[:, i - 1])
            # The look-ahead state runs ahead of the output; what its warp moves out of the picture
            # stays in the ring, to be brought back when the output state gets there.
            canvas = average_splat(self.ringed(ahead), flow).to(ahead.dtype)
            kept.appendleft((canvas, flow))
            ahead = self.backward_rnn(images[:, i], maps[:, i], centre(canvas, ahead.shape[-2:]))
            o = i - self.look_ahead
            if o < 0:
                continue
            if o > 0:
                state = warp_inside(state, flows.backward[:, o - 1])
                state = self.forward_rnn(images[:, o], maps[:, o], state)
            restored.append(self.d(state, self.brought_back(ahead, kept)))
        return torch.stack(restored, dim=1)

    def brought_back(self, state: Tensor, kept: deque[tuple[Tensor, Tensor]]) -> Tensor:
        """Warp a state [B, w, H, W] back through the kept canvases and flows, newest first -> [B, w, H, W]."""
        size = state.shape[-2:]
        for canvas, flow in kept:
            filled = canvas.clone()
            centre(filled, size).copy_(state)
            state = centre(warp_inside(filled, flow), size)
        return state

    def ringed(self, x: Tensor) -> Tensor:
        """[B, c, H, W] -> the same in a ring of zeros."""
        rows, columns = (int(self.config.border * side) for side in x.shape[-2:])
        return F.pad(x, (columns, columns, rows, rows))


class RecurrentNet(nn.Module):
    """Makes the next state from an image, its noise map and the state that was brought to it."""

    def __init__(self, config: FloRNNConfig) -> None:
        """Make the layers."""
        super().__init__()
        inputs = 2 * config.image_channels + config.width
        self.width = config.width
        self.first_conv = nn.Conv2d(inputs, config.width, 3, padding=1, bias=False)
        self.resblocks = nn.Sequential(*(ResidualBlock(config.width) for _ in range(config.blocks)))

    def forward(self, image: Tensor, noise: Tensor, state: Tensor | None = None) -> Tensor:
        """Image and noise map [B, C, H, W], state [B, w, H, W] (None: zero) -> next state [B, w, H, W]."""
        if state is None:
            state = image.new_zeros(len(image), self.width, *image.shape[-2:])
        return self.resblocks(self.first_conv(torch.cat([image, noise, state], dim=1)))


class ResidualBlock(nn.Module):
    """Two convolutions with ReLU between, added to the input."""

    def __init__(self, width: int) -> None:
        """Make the layers."""
        super().__init__()
        self.conv1 = nn.Conv2d(width, width, 3, padding=1, bias=False)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """[B, w, H, W] -> the same shape."""
        return x + self.conv2(F.relu(self.conv1(x)))


class Decoder(nn.Module):
    """Makes the restored image from both states."""

    def __init__(self, config: FloRNNConfig) -> None:
        """Make the layers."""
        super().__init__()
        both = 2 * config.width
        self.convs = nn.Sequential(
            nn.Conv2d(both, both, 3, padding=1, bias=False),
            nn.ReLU(),
            nn.Conv2d(both, config.image_channels, 3, padding=1, bias=False),
        )

    def forward(self, state: Tensor, ahead: Tensor) -> Tensor:
        """State of the output net and look-ahead state, both [B, w, H, W] -> restored image [B, C, H, W]."""
        return self.convs(torch.cat([state, ahead], dim=1))


def centre(canvas: Tensor, size: torch.Size) -> Tensor:
    """Return a view of the middle [..., H, W] of a canvas with a ring."""
    top, left = ((outer - inner) // 2 for outer, inner in zip(canvas.shape[-2:], size, strict=True))
    return canvas[..., top : top + size[0], left : left + size[1]]


def warp_inside(image: Tensor, flow: Tensor) -> Tensor:
    """Warp [B, c, H, W] backward along a flow [B, 2, H, W]; 0 where any part would come from outside."""
    # A warped channel of ones is below 1 where bilinear sampling took a part from outside.
    moved = warp(torch.cat([image, torch.ones_like(image[:, :1])], dim=1), flow, "zeros")
    return (moved[:, :-1] * (moved[:, -1:] >= VALID)).to(image.dtype)


def reflected_flows(flows: Flows, more: int) -> Flows:
    """Flows of a clip, T-1 each [B, T-1, 2, H, W] -> those of the clip with `more` reflected frames, T-1+more forward.

    Backwards in time, the forward flow of the extended clip is the backward flow of the clip.
    """
    count = flows.forward.shape[1] + 1
    if count == 1:
        still = flows.forward.new_zeros(len(flows.forward), more, *flows.forward.shape[2:])
        return Flows(still, flows.backward)
    order = reflected(0, count + more, count)
    both = torch.cat([flows.forward, flows.backward], dim=1)
    places = [a if a < b else count - 1 + b for a, b in pairwise(order)]
    return Flows(both[:, places], flows.backward)
