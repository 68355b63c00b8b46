"""QUIVER (Chennuri et al., ECCV 2024): eleven few-bit frames in, the restored centre frame out.

    codes/(2^b - 1) [B, T, 1, H, W] -> denoised frames, flows, aligned and fused features, recurrent fusion,
    temporal attention, refinement from 1/4 to full scale -> Output

With the presets `quiver` and `quiver-s` this is the published network to the last digit
(tests/quiver/model/test_golden.py); what else can be set, and the preset `nano`, is in config.py.
"""

from collections.abc import Callable, Sequence

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
    neighbourhoods,
    resize,
)
from quiver.model.config import Config
from quiver.model.initial_estimate import InitialEstimate

CHUNK_PIXELS = 2**16  # without gradients, frames are taken together up to this many pixels

Pair = tuple[Tensor, Tensor]  # of the previous and the current frame
Encoded = tuple[Tensor, Tensor, Tensor]  # R1, R2 and the recurrent cell's entry


class QUIVER(nn.Module):
    """The network; stages are methods, so that a caller may compute each frame's share once (schedules.py)."""

    def __init__(self, config: Config | int | None = None, *, channels: int | None = None) -> None:
        """The network of a configuration, or the published one of so many channels; 64 by default."""
        super().__init__()
        if channels is not None and config is not None:
            raise ValueError("QUIVER takes a configuration or a number of channels, got both")
        if isinstance(config, int):
            config = Config(channels=config)
        elif config is None:
            config = Config() if channels is None else Config(channels=channels)
        self.config = config
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
        self.attention = TemporalAttention(
            stacked, config.attention_width or stacked, 4 * c, config.attention_temperature
        )
        self.refine4 = Refinement(image, c)
        self.refine = Refinement(image, c)
        self.baseline = (
            InitialEstimate(config.baseline, config.sweep if config.flow else 0.0) if config.baseline else None
        )
        if config.lecun and not self.alignment.weight.is_meta:  # nothing to draw without memory
            start_from_lecun(self)
        if config.baseline:
            start_from_baseline(self)

    @property
    def multiple(self) -> int:
        """Height and width must be multiples of this; callers pad."""
        return 4 * self.config.fold

    # Stages

    def fold(self, frames: Tensor) -> Tensor:
        """[B, T, 1, H, W] -> [B, T, f2, H/fold, W/fold]."""
        return F.pixel_unshuffle(frames, self.config.fold) if self.config.fold > 1 else frames

    def unfold(self, frames: Tensor) -> Tensor:
        return F.pixel_shuffle(frames, self.config.fold) if self.config.fold > 1 else frames

    def denoise(self, frames: Tensor) -> Tensor:
        """Folded frames [N, f2, h, w] -> the same, each denoised on its own."""
        return frames if self.denoiser is None else self.denoiser(frames)

    def flows(self, reference: Tensor, support: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Folded denoised frames [N, f2, h, w] -> flow [N, 2, h/s, w/s] for s = 1, 2, 4; zero in the ablation."""
        if self.flow is None:
            count, _, height, width = reference.shape
            return tuple(reference.new_zeros(count, 2, height // s, width // s) for s in (1, 2, 4))  # type: ignore[return-value]
        return self.flow(reference.mean(1, keepdim=True), support.mean(1, keepdim=True))

    def fuse(self, noisy: Sequence[Pair], denoised: Sequence[Pair], flows: Sequence[Tensor]) -> list[Tensor]:
        """(previous, current) features of both streams and flows, per scale -> fused features [N, C, h/s, w/s]."""
        return [
            fusion(self.alignment(*of_denoised, flow), self.alignment(*of_noisy, flow))
            for fusion, of_denoised, of_noisy, flow in zip(self.fusions, denoised, noisy, flows, strict=True)
        ]

    def encode_first(self, images: Sequence[Tensor]) -> Encoded:
        """The first frame of a window, [N, f2, h/s, w/s] per scale: its aligned features are zero by definition."""
        c = self.config.channels
        zero = [image.new_zeros(image.shape[0], c, *image.shape[2:]) for image in images]
        return self.cell.encode(images, [fusion(z, z) for fusion, z in zip(self.fusions, zero, strict=True)])

    def encode_next(
        self, images: Sequence[Tensor], noisy: Sequence[Pair], denoised: Sequence[Pair], flows: Sequence[Tensor]
    ) -> Encoded:
        """A later frame: images, (previous, current) features of both streams and flows, each at three scales."""
        return self.cell.encode(images, self.fuse(noisy, denoised, flows))

    def restore(self, window: Sequence[Tensor], r1: Tensor, r2: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """R4 of eleven frames, R1 and R2 of their centre -> folded pictures at scales 1, 2, 4 (without baseline)."""
        attended = self.attention(window)
        nothing = attended.new_zeros(attended.shape[0], self.config.fold**2, *attended.shape[2:])
        picture4, g = self.refine4(attended, torch.zeros_like(attended), nothing)
        picture2, g = self.refine(r2, *self._onward(self.refine4, g, picture4))
        picture1, _ = self.refine(r1, *self._onward(self.refine, g, picture2))  # its hidden branch leads nowhere
        return picture1, picture2, picture4

    def _onward(self, refinement: nn.Module, g: Tensor, picture: Tensor) -> tuple[Tensor, Tensor]:
        assert isinstance(refinement, Refinement)
        hidden, up = refinement.onward(g, picture)
        return hidden, up if self.config.multi_scale else torch.zeros_like(up)

    def first_state(self, entry: Tensor) -> Tensor:
        """The zero state [N, 2C, h/4, w/4] before the first frame."""
        return entry.new_zeros(entry.shape[0], 2 * self.config.channels, *entry.shape[2:])

    def base(self, frames: Sequence[Tensor]) -> Tensor | None:
        """The baseline picture of eleven folded frames [B, f2, h, w]; None where the network has none."""
        return None if self.baseline is None else self.baseline(frames)

    # The network

    def forward(self, x: Tensor, baseline_only: bool = False) -> Output:
        """[B, T, 1, H, W] of codes/(2^b - 1), T >= 11, H and W multiples of `multiple`; ValueError otherwise.

        With `baseline_only` scale 1 is the baseline's picture, and all that comes after it is left out.
        """
        check_input(x, self.multiple)
        frames = self.fold(x)
        centres = range(RADIUS, x.shape[1] - RADIUS)
        bases = [self.base(frames[:, t - RADIUS : t + RADIUS + 1].unbind(1)) for t in centres]
        if baseline_only:
            if self.baseline is None:
                raise ValueError("this network has no baseline (Config.baseline = 0)")
            return Output(None, self.unfold(torch.stack([base for base in bases if base is not None], 1)), None, None)
        denoised = _per_frame(self.denoise, frames)[0]
        flows = _per_frame(self.flows, denoised[:, 1:], denoised[:, :-1])
        r1, r2, entries = self._encode(frames, denoised, flows)
        r4 = self.recur(entries)
        pictures = [
            add_base(self.restore(r4[t - RADIUS : t + RADIUS + 1], r1[t], r2[t]), base)
            for t, base in zip(centres, bases, strict=True)
        ]
        scales: list[Tensor | None] = [self.unfold(torch.stack(p, dim=1)) for p in zip(*pictures, strict=True)]
        if not self.config.multi_scale:
            scales[1:] = (None, None)
        flow = resize(flows[0], *x.shape[3:]) * self.config.fold if self.config.flow else None
        assert scales[0] is not None
        return Output(
            self.unfold(denoised) if self.config.pre_denoiser else None, scales[0], scales[1], scales[2], flow
        )

    def _encode(
        self, frames: Tensor, denoised: Tensor, flows: Sequence[Tensor]
    ) -> tuple[dict[int, Tensor], dict[int, Tensor], list[Tensor]]:
        """R1 and R2 of the centre frames (by index) and the recurrent cell's entries of all frames."""
        length, (height, width) = frames.shape[1], frames.shape[3:]
        images = (frames, *(resize(frames, height // k, width // k) for k in (2, 4)))
        noisy = _per_frame(self.noisy_features, neighbourhoods(frames))
        clean = _per_frame(self.denoised_features, neighbourhoods(denoised))

        def pairs(features: Sequence[Tensor], part: slice) -> list[Pair]:
            return [(_flat(f[:, :-1][:, part]), _flat(f[:, 1:][:, part])) for f in features]

        r1, r2 = {}, {}
        entries = [self.encode_first([image[:, 0] for image in images])[2]]
        for part in _parts(length - 1, frames):
            now = [_flat(image[:, 1:][:, part]) for image in images]
            along = [_flat(flow[:, part]) for flow in flows]
            encoded = self.encode_next(now, pairs(noisy, part), pairs(clean, part), along)
            by_time = [e.view(frames.shape[0], -1, *e.shape[1:]).unbind(1) for e in encoded]
            for t, (full, half, entry) in enumerate(zip(*by_time, strict=True), start=len(entries)):
                entries.append(entry)
                if RADIUS <= t < length - RADIUS:
                    r1[t], r2[t] = full, half
        return r1, r2, entries

    def recur(self, entries: Sequence[Tensor]) -> list[Tensor]:
        """R4 of every frame in time order; the state after the last frame is not computed."""
        state, results = self.first_state(entries[0]), []
        for t, entry in enumerate(entries):
            results.append(self.cell.step(entry, state))
            if t + 1 < len(entries):
                state = self.cell.state(results[-1])
        return results


def add_base(pictures: Sequence[Tensor], base: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Folded pictures at three scales plus the base, resized to each."""
    if base is not None:
        pictures = [p + resize(base, *p.shape[2:]) for p in pictures]
    return pictures[0], pictures[1], pictures[2]


def start_from_lecun(network: QUIVER) -> None:
    """Normal weights of variance 1/fan-in and zero biases; the alignment still starts from the flow alone.

    PyTorch's own start has a third of that variance: through the products of the gated fusion, little is left of it.
    """
    own_start = set() if network.baseline is None else set(network.baseline.modules())  # PyTorch's: made of ReLU
    for module in network.modules():
        if module not in own_start and isinstance(module, nn.Conv2d | nn.Conv3d | nn.Linear):
            nn.init.normal_(module.weight, std=module.weight[0].numel() ** -0.5)
            if module.bias is not None:
                nn.init.zeros_(module.bias)
    nn.init.normal_(network.alignment.weight, std=2 * network.alignment.weight[0].numel() ** -0.5)  # masks start at 1/2
    last = network.alignment.offsets[-1]
    assert isinstance(last, nn.Conv2d)
    nn.init.zeros_(last.weight)


def start_from_baseline(network: QUIVER) -> None:
    """Let the untrained network return about the mean of the middle frames.

    The last layers of the pre-denoiser and of the baseline are shrunk. Those of the picture branches are zero, as are
    the pictures handed on to the next scale: at the start the recurrent part adds nothing to the baseline.
    """
    assert network.baseline is not None
    shrunk = [network.baseline.correction.leave, *([] if network.denoiser is None else [network.denoiser.leave])]
    with torch.no_grad():
        for layer in shrunk:
            assert layer.bias is not None
            layer.weight.mul_(0.03)
            layer.bias.zero_()
        for refinement in (network.refine4, network.refine):
            for tensor in (*refinement.picture[-1].parameters(), *refinement.next_picture.parameters()):
                tensor.zero_()


def _flat(stack: Tensor) -> Tensor:
    return stack.flatten(0, 1)


def _per_frame(stage: Callable[..., Tensor | tuple[Tensor, ...]], *stacks: Tensor) -> list[Tensor]:
    """Apply a stage of [N, ...] tensors to [B, T, ...] stacks; without gradients a few frames at a time."""
    collected: list[list[Tensor]] = []
    for part in _parts(stacks[0].shape[1], stacks[0]):
        results = stage(*(_flat(stack[:, part]) for stack in stacks))
        results = (results,) if isinstance(results, Tensor) else results
        collected.append([r.view(stacks[0].shape[0], -1, *r.shape[1:]) for r in results])
    return [torch.cat(pieces, dim=1) if len(pieces) > 1 else pieces[0] for pieces in zip(*collected, strict=True)]


def _parts(length: int, frames: Tensor) -> list[slice]:
    """Slices of time: everything with gradients, else as many frames as CHUNK_PIXELS allow, at least one."""
    pixels = frames.shape[0] * frames.shape[-2] * frames.shape[-1]
    step = length if torch.is_grad_enabled() else max(1, CHUNK_PIXELS // pixels)
    return [slice(start, start + step) for start in range(0, length, step)]
