"""Films a picture with a known affine motion of the camera in every frame, to tell whether it is found."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as functional

OFFSETS = tuple(range(-5, 6))
SCALES = (8, 4, 2)


def scenery(rng: np.random.Generator, height: int, width: int, margin: int = 32) -> torch.Tensor:
    """Return a picture with detail at all scales, float32 [height + 2 margin, width + 2 margin], deviation 1."""
    size = (height + 2 * margin, width + 2 * margin)
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(size[0]), np.fft.rfftfreq(size[1]), indexing="ij"))
    spectrum = np.fft.rfft2(rng.standard_normal(size)) / np.maximum(frequency, 0.02) ** 1.2
    spectrum[frequency > 0.25] = 0  # so that interpolation is exact enough to be no part of the error
    picture = np.fft.irfft2(spectrum, s=size)
    return torch.from_numpy((picture / picture.std()).astype(np.float32))


def filmed(picture: torch.Tensor, motion: torch.Tensor, height: int, width: int, margin: int = 32) -> torch.Tensor:
    """Return the frames [K, height, width] of which frame(p + motion(p)) = picture(p + margin); bicubic."""
    unit = torch.tensor([2 / height, 2 / width])  # affine motion is inverted in places from -1 to 1 across the frame
    frames = []
    for of_frame in motion:
        scaled = of_frame * unit[:, None]
        there = torch.eye(2) + scaled[:, 1:]
        back = torch.linalg.inv(there)
        y = (torch.arange(height) + 0.5) * 2 / height - 1
        x = (torch.arange(width) + 0.5) * 2 / width - 1
        q = torch.stack(torch.meshgrid(y, x, indexing="ij"), -1)
        p = (q - scaled[:, 0]) @ back.T
        grid = torch.stack([p[..., 1] * width / (width + 2 * margin), p[..., 0] * height / (height + 2 * margin)], -1)
        frames.append(
            functional.grid_sample(
                picture[None, None], grid[None], mode="bicubic", padding_mode="border", align_corners=False
            )[0, 0]
        )
    return torch.stack(frames)


def pyramid_of(frames: torch.Tensor) -> dict[int, torch.Tensor]:
    """Return frames [..., H, W] pooled at every scale."""
    return {scale: functional.avg_pool2d(frames, scale) for scale in SCALES}


def shake(rng: np.random.Generator, size: float, turn: float) -> torch.Tensor:
    """Return motion [K, 2, 3] without any smooth path: px per frame at random, zero for the reference."""
    steps = rng.normal(0, 1, (len(OFFSETS), 2, 3)) * [size, turn, turn]
    return torch.from_numpy((steps - steps[OFFSETS.index(0)]).astype(np.float32))
