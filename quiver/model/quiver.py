"""Defines QUIVER (Chennuri et al., ECCV 2024): eleven few-bit frames in, the restored centre frame out.

    codes/(2^b - 1) [B, T, 1, H, W] -> denoised frames, flows, aligned and fused features, recurrent fusion,
    temporal attention, refinement from 1/4 to full scale -> Output

Every stage agrees with the published network (tests/quiver/model/test_golden.py).
"""

from __future__ import annotations  # a type that is computed inside of a call would cut a compiled network in two

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from quiver.model.blocks import (
    RADIUS,
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

CHUNK_PIXELS = 2**12  # without gradients, frames are computed together up to this many; more take longer on a CPU

Pair = tuple[Tensor, Tensor]  # of the previous and the current frame
Encoded = tuple[Tensor, Tensor, Tensor]  # R1, R2 and the recurrent cell's entry


class QUIVER(nn.Module):
    """The published network. Its stages are methods, so that schedules.py can compute the share of a frame once."""

    config: Config
    denoiser: PreDenoiser | None
    flow: FlowNetwork | None
    multiple: int = 4  # height and width must be multiples of this; callers pad
    stride: int = 16  # px: a shift of the frame by a multiple of this moves the coarsest flow by complete pixels

    def __init__(self, config: Config | int | None = None, *, channels: int | None = None) -> None:
        """Make the network of a configuration, or the published one with so many channels; 64 by default."""
        super().__init__()
        if channels is not None and config is not None:
            raise ValueError("QUIVER takes a configuration or a number of channels, got both")
        if isinstance(config, int):
            config = Config(channels=config)
        elif config is None:
            config = Config() if channels is None else Config(channels=channels)
        self.config = config
        c = config.channels
        self.denoiser = PreDenoiser(c, config.denoiser_growth) if config.pre_denoiser else None
        self.flow = FlowNetwork(config.flow_channels, kernel=7, levels=4) if config.flow else None
        self.noisy_features = Extractor(c)
        self.denoised_features = Extractor(c)
        self.alignment = Alignment(c, config.deformable_groups)
        self.fusions = nn.ModuleList(GatedFusion(c) for _ in range(3))
        self.cell = RecurrentCell(c, config.cell_growth or 2 * c)
        self.attention = TemporalAttention(c)
        self.refine4 = Refinement(c)
        self.refine = Refinement(c)

    def forward(self, x: Tensor) -> Output:
        """[B, T, 1, H, W] of codes/(2^b - 1), T >= 11, H and W multiples of 4; ValueError otherwise."""
        check_input(x, self.multiple)
        return self.restored(x)

    def restored(self, frames: Tensor) -> Output:
        """Run all stages on frames [B, T, 1, H, W], unchecked."""
        denoised = _per_frame(self.denoise, frames)[0]
        flows = _per_frame(self.flows, denoised[:, 1:], denoised[:, :-1])
        r1, r2, entries = self._encode(frames, denoised, flows)
        r4 = self.recur(entries)
        centres = range(RADIUS, frames.shape[1] - RADIUS)
        pictures = [self.restore(r4[t - RADIUS : t + RADIUS + 1], r1[t], r2[t]) for t in centres]
        scale1, scale2, scale4 = (torch.stack(of_scale, dim=1) for of_scale in zip(*pictures, strict=True))
        return Output(
            denoised if self.config.pre_denoiser else None,
            scale1,
            scale2 if self.config.multi_scale else None,
            scale4 if self.config.multi_scale else None,
            tuple(flows) if self.config.flow else None,
        )

    def parts(self, x: Tensor) -> tuple[Tensor | None, list[Tensor] | None]:
        """[B, T, 1, H, W] as of `forward` -> denoised frames and flows as in `Output`, without the later stages."""
        check_input(x, self.multiple)
        denoised = _per_frame(self.denoise, x)[0]
        flows = _per_frame(self.flows, denoised[:, 1:], denoised[:, :-1]) if self.config.flow else None
        return denoised if self.config.pre_denoiser else None, flows

    # Stages

    def denoise(self, frames: Tensor) -> Tensor:
        """Frames [N, 1, h, w] -> the same shape, each frame denoised alone."""
        return frames if self.denoiser is None else self.denoiser(frames)

    def flows(self, reference: Tensor, support: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Denoised frames [N, 1, h, w] -> flow [N, 2, h/s, w/s] in pixels, s = 1, 2, 4; zero in the ablation."""
        if self.flow is None:
            count, _, height, width = reference.shape
            return tuple(reference.new_zeros(count, 2, height // s, width // s) for s in (1, 2, 4))  # type: ignore[return-value]
        return self.flow(reference, support)

    def fuse(self, noisy: Sequence[Pair], denoised: Sequence[Pair], flows: Sequence[Tensor]) -> list[Tensor]:
        """Per scale: (previous, current) features of both streams and a flow -> fused features [N, C, h/s, w/s]."""
        return [
            fusion(self.alignment(*of_denoised, flow), self.alignment(*of_noisy, flow))
            for fusion, of_denoised, of_noisy, flow in zip(self.fusions, denoised, noisy, flows, strict=True)
        ]

    def encode_first(self, images: Sequence[Tensor]) -> Encoded:
        """Encode the first frame of a window, [N, 1, h/s, w/s] per scale; its aligned features are zero."""
        c = self.config.channels
        zero = [image.new_zeros(image.shape[0], c, *image.shape[2:]) for image in images]
        return self.cell.encode(images, [fusion(z, z) for fusion, z in zip(self.fusions, zero, strict=True)])

    def encode_next(
        self, images: Sequence[Tensor], noisy: Sequence[Pair], denoised: Sequence[Pair], flows: Sequence[Tensor]
    ) -> Encoded:
        """Encode a later frame: images [N, 1, h, w], (previous, current) features and flows, at three scales."""
        return self.cell.encode(images, self.fuse(noisy, denoised, flows))

    def restore(self, window: Sequence[Tensor], r1: Tensor, r2: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """R4 of eleven frames, R1 and R2 of their centre -> pictures [N, 1, h/s, w/s] at scales 1, 2, 4."""
        attended = self.attention(window)
        nothing = attended.new_zeros(attended.shape[0], 1, *attended.shape[2:])
        picture4, g = self.refine4(attended, torch.zeros_like(attended), nothing)
        picture2, g = self.refine(r2, *self._onward(self.refine4, g, picture4))
        picture1, _ = self.refine(r1, *self._onward(self.refine, g, picture2))  # its hidden branch is not used
        return picture1, picture2, picture4

    def _onward(self, refinement: Refinement, g: Tensor, picture: Tensor) -> tuple[Tensor, Tensor]:
        hidden, up = refinement.onward(g, picture)
        return hidden, up if self.config.multi_scale else torch.zeros_like(up)

    def first_state(self, entry: Tensor) -> Tensor:
        """Return the zero state [N, 2C, h/4, w/4] that precedes the first frame."""
        return entry.new_zeros(entry.shape[0], 2 * self.config.channels, *entry.shape[2:])

    def _encode(
        self, frames: Tensor, denoised: Tensor, flows: Sequence[Tensor]
    ) -> tuple[dict[int, Tensor], dict[int, Tensor], list[Tensor]]:
        """Return R1 and R2 of the centre frames by index, and the recurrent cell's entries of all frames."""
        length = frames.shape[1]
        height, width = frames.shape[3:]
        images = (frames, *(resize(frames, height // k, width // k) for k in (2, 4)))
        noisy = _per_frame(self.noisy_features, neighbourhoods(frames))
        clean = _per_frame(self.denoised_features, neighbourhoods(denoised))

        def pairs(features: Sequence[Tensor], part: slice) -> list[Pair]:
            return [(_flat(f[:, :-1][:, part]), _flat(f[:, 1:][:, part])) for f in features]

        r1 = {}
        r2 = {}
        entries = [self.encode_first([image[:, 0] for image in images])[2]]
        for part in _parts(length - 1, frames):
            now = [_flat(image[:, 1:][:, part]) for image in images]
            along = [_flat(flow[:, part]) for flow in flows]
            encoded = self.encode_next(now, pairs(noisy, part), pairs(clean, part), along)
            by_time = [e.view(frames.shape[0], -1, *e.shape[1:]).unbind(1) for e in encoded]
            for t, (full, half, entry) in enumerate(zip(*by_time, strict=True), start=len(entries)):
                entries.append(entry)
                # Only frames with a complete window are restored, so only theirs is kept.
                if RADIUS <= t < length - RADIUS:
                    r1[t] = full
                    r2[t] = half
        return r1, r2, entries

    def recur(self, entries: Sequence[Tensor]) -> list[Tensor]:
        """Entries [N, 6C, h, w] in time order -> R4 [N, 4C, h, w] of every frame; the last state is not computed."""
        state = self.first_state(entries[0])
        results = []
        for t, entry in enumerate(entries):
            results.append(self.cell.step(entry, state))
            if t + 1 < len(entries):
                state = self.cell.state(results[-1])
        return results


def _flat(stack: Tensor) -> Tensor:
    return stack.flatten(0, 1)


def _per_frame(stage: Callable[..., Tensor | tuple[Tensor, ...]], *stacks: Tensor) -> list[Tensor]:
    """Apply a stage on [N, ...] tensors to [B, T, ...] stacks; without gradients a few frames at a time."""
    collected: list[list[Tensor]] = []
    for part in _parts(stacks[0].shape[1], stacks[0]):
        results = stage(*(_flat(stack[:, part]) for stack in stacks))
        results = (results,) if isinstance(results, Tensor) else results
        collected.append([r.view(stacks[0].shape[0], -1, *r.shape[1:]) for r in results])
    return [torch.cat(pieces, dim=1) if len(pieces) > 1 else pieces[0] for pieces in zip(*collected, strict=True)]


def _parts(length: int, frames: Tensor) -> list[slice]:
    """Return slices of time: one with gradients; otherwise of as many frames as CHUNK_PIXELS allow, at least one."""
    pixels = frames.shape[0] * frames.shape[-2] * frames.shape[-1]
    step = length if torch.is_grad_enabled() else max(1, CHUNK_PIXELS // pixels)
    return [slice(start, start + step) for start in range(0, length, step)]
