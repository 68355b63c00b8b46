"""Defines FoldedQUIVER, our small network: QUIVER's stages on folded frames, plus an initial estimate.

    codes/(2^b - 1) [B, T, 1, H, W] -> initial estimate of each centre frame
    the same, folded [B, T, f^2, H/f, W/f] -> QUIVER's stages -> what they add to the estimate -> Output

QUIVER needs days of training. Here blocks of f x f pixels become channels, every part is small, and a small U-Net over
aligned frames makes an initial estimate, which is trained within minutes. The defaults are the preset `nano`.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from quiver.model.blocks import (
    RADIUS,
    WINDOW,
    Alignment,
    Extractor,
    FlowNetwork,
    GatedFusion,
    Output,
    PreDenoiser,
    RecurrentCell,
    Refinement,
    TemporalAttention,
    check_input,
    resize,
)
from quiver.model.config import Config, flag, real_number, whole_number
from quiver.model.initial_estimate import InitialEstimate
from quiver.model.quiver import QUIVER

# Least and largest value of each number: a configuration comes from a file, and a network is built before its weights
# are compared with it.
_WHOLE = {
    "deformable_kernel": (1, 15),
    "denoiser_passes": (1, 64),
    "flow_kernel": (1, 31),
    "flow_levels": (3, 10),
    "cell_blocks": (1, 64),
    "attention_width": (1, 2**16),
    "fold": (1, 16),
    "estimate_width": (0, 1024),
}


@dataclass(frozen=True)
class FoldedConfig(Config):
    """Configuration of a FoldedQUIVER network: QUIVER's own fields, and the sizes that the paper fixes."""

    channels: int = 4
    deformable_groups: int = 1  # of channels that share offsets
    deformable_kernel: int = 1  # side of the deformable convolution
    denoiser_growth: int = 4  # channels that a dense layer of the pre-denoiser adds
    denoiser_passes: int = 1  # runs of its one block
    flow_channels: tuple[int, ...] = (8, 8)  # widths of the layers of each flow level
    flow_kernel: int = 3
    flow_levels: int = 3  # of the pyramid, at least 3
    cell_blocks: int = 1  # residual dense blocks of the recurrent cell
    attention_width: int | None = 32  # channels of the temporal attention; None = 44C
    attention_temperature: float | None = 8.0  # initial value of a learnt factor on the logits; None = no factor
    fold: int = 2  # side of the blocks of pixels that become channels (1 = none)
    estimate_width: int = 32  # channels of the initial estimate's U-Net; 0 = no initial estimate
    largest_velocity: float = 7.0  # px/frame, of the search that aligns the estimate's frames; 0 = no alignment
    lecun: bool = True  # initial weights of variance 1/fan-in (LeCun, as in the paper) and biases of zero

    def __post_init__(self) -> None:
        """Raise `ValueError` for a value out of range."""
        for name, (least, most) in _WHOLE.items():
            value = getattr(self, name)
            if value is not None or name != "attention_width":
                whole_number(f"FoldedConfig.{name}", value, least, most)
        if self.attention_temperature is not None:
            real_number("FoldedConfig.attention_temperature", self.attention_temperature, -1e6, 1e6)
        real_number("FoldedConfig.largest_velocity", self.largest_velocity, 0.0, 32.0)
        flag("FoldedConfig.lecun", self.lecun)
        for name in ("flow_kernel", "deformable_kernel"):
            if getattr(self, name) % 2 == 0:
                raise ValueError(f"Config.{name} must be odd, got {getattr(self, name)}")
        super().__post_init__()


class ScaledAttention(TemporalAttention):
    """Temporal attention with a learnt factor on its logits; in [-1, 1] their softmax is nearly uniform."""

    def __init__(self, inputs: int, width: int, outputs: int, temperature: float) -> None:
        super().__init__(inputs, width, outputs)
        self.temperature = nn.Parameter(torch.tensor(float(temperature)))

    def logits(self, q: Tensor, k: Tensor) -> Tensor:
        """Queries and keys [N, D, hw] -> scaled cosine of every pair [N, D, D]."""
        return super().logits(q, k) * self.temperature


class FoldedQUIVER(QUIVER):
    """QUIVER's stages with parts of any size on folded frames; their pictures are added to an initial estimate."""

    config: FoldedConfig

    def __init__(self, config: FoldedConfig | None = None) -> None:
        nn.Module.__init__(self)  # QUIVER.__init__ makes parts of the published sizes
        config = FoldedConfig() if config is None else config
        self.config = config
        self.multiple = 4 * config.fold
        self.stride = 2**config.flow_levels * config.fold
        c, image = config.channels, config.fold**2
        self.denoiser = (
            PreDenoiser(image, c, config.denoiser_growth, config.denoiser_passes) if config.pre_denoiser else None
        )
        self.flow = FlowNetwork(config.flow_channels, config.flow_kernel, config.flow_levels) if config.flow else None
        self.noisy_features = Extractor(image, c)
        self.denoised_features = Extractor(image, c)
        self.alignment = Alignment(c, config.deformable_groups, config.deformable_kernel)
        self.fusions = nn.ModuleList(GatedFusion(c) for _ in range(3))
        self.cell = RecurrentCell(image, c, config.cell_blocks, config.cell_growth or 2 * c)
        stacked = 4 * c * WINDOW
        widths = (stacked, config.attention_width or stacked, 4 * c)
        self.attention = (
            TemporalAttention(*widths)
            if config.attention_temperature is None
            else ScaledAttention(*widths, config.attention_temperature)
        )
        self.refine4 = Refinement(image, c)
        self.refine = Refinement(image, c)
        velocity = config.largest_velocity if config.flow else 0.0
        self.estimate = InitialEstimate(config.estimate_width, velocity) if config.estimate_width else None
        if config.lecun and not self.alignment.weight.is_meta:  # nothing to draw without memory
            _set_lecun_weights(self)
        if self.estimate is not None:
            _set_initial_picture(self, self.estimate)

    def fold(self, frames: Tensor) -> Tensor:
        """Fold frames [..., 1, H, W] -> [..., f2, H/f, W/f]."""
        return F.pixel_unshuffle(frames, self.config.fold) if self.config.fold > 1 else frames

    def unfold(self, frames: Tensor) -> Tensor:
        """Unfold frames [..., f2, H/f, W/f] -> [..., 1, H, W]."""
        return F.pixel_shuffle(frames, self.config.fold) if self.config.fold > 1 else frames

    def flows(self, reference: Tensor, support: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Folded denoised frames [N, f2, h, w] -> flow [N, 2, h/s, w/s] in folded pixels, s = 1, 2, 4."""
        return super().flows(reference.mean(1, keepdim=True), support.mean(1, keepdim=True))

    def forward(self, x: Tensor, estimate_only: bool = False) -> Output:
        """[B, T, 1, H, W] of codes/(2^b - 1), T >= 11, H and W multiples of `multiple`; ValueError otherwise.

        With `estimate_only`, scale 1 is the initial estimate, and the later stages are not computed.
        """
        check_input(x, self.multiple)
        frames, estimates = self.fold(x), None
        if self.estimate is not None:
            windows = (frames[:, t - RADIUS : t + RADIUS + 1] for t in range(RADIUS, x.shape[1] - RADIUS))
            estimates = torch.stack([self.estimate(window.unbind(1)) for window in windows], dim=1)
        if estimate_only:
            if estimates is None:
                raise ValueError("this network has no initial estimate (FoldedConfig.estimate_width = 0)")
            return Output(None, self.unfold(estimates), None, None)
        found = self.restored(frames)

        def finished(picture: Tensor) -> Tensor:
            return self.unfold(picture if estimates is None else picture + resize(estimates, *picture.shape[3:]))

        return Output(
            None if found.denoised is None else self.unfold(found.denoised),
            finished(found.scale1),
            None if found.scale2 is None else finished(found.scale2),
            None if found.scale4 is None else finished(found.scale4),
            None if found.flow is None else resize(found.flow, *x.shape[3:]) * self.config.fold,
        )


def _set_lecun_weights(network: FoldedQUIVER) -> None:
    """Draw normal weights of variance 1/fan-in and set biases to zero; the alignment still starts from the flow alone.

    PyTorch's defaults have a third of that variance, of which the products of the gated fusion leave little.
    """
    kept = set() if network.estimate is None else set(network.estimate.modules())  # keeps PyTorch's, which suits ReLU
    for module in network.modules():
        if module not in kept and isinstance(module, nn.Conv2d | nn.Conv3d | nn.Linear):
            nn.init.normal_(module.weight, std=module.weight[0].numel() ** -0.5)
            if module.bias is not None:
                nn.init.zeros_(module.bias)
    nn.init.normal_(network.alignment.weight, std=2 * network.alignment.weight[0].numel() ** -0.5)  # masks start at 1/2
    last = network.alignment.offsets[-1]
    assert isinstance(last, nn.Conv2d)
    nn.init.zeros_(last.weight)


def _set_initial_picture(network: FoldedQUIVER, estimate: InitialEstimate) -> None:
    """Make the untrained network return about the mean of the middle frames.

    The last layers of the pre-denoiser and of the estimate become small. The last layers of the picture branches become
    zero, as do the pictures for the next scale: before training the recurrent part adds nothing to the estimate.
    """
    with torch.no_grad():
        for layer in (estimate.correction.leave, *([] if network.denoiser is None else [network.denoiser.leave])):
            assert layer.bias is not None
            layer.weight.mul_(0.03)
            layer.bias.zero_()
        for refinement in (network.refine4, network.refine):
            for tensor in (*refinement.picture[-1].parameters(), *refinement.next_picture.parameters()):
                tensor.zero_()
