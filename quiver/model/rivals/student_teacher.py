"""Defines Student-Teacher: one network that restores noisy moving frames, led by two that see noise or motion alone.

    eleven noisy frames -> two encoders, for motion and for noise -> features of both at full and half size -> decoder
    -> plus the centre frame -> restored centre frame

In training, the features of each encoder are pulled towards those of a teacher (`distillation_loss`). The motion
teacher takes eleven sharp frames of a moving scene, the noise teacher eleven noisy copies of one frame. Each has one
encoder and the same decoder, and learns to give the centre frame before the student begins.

Our reading: the article (Chi, Gnanasambandam, Koltun and Chan, ECCV 2020) has no public program, and we know its idea
only. All sizes and weights are our own. Results are those of "Student-Teacher (our reading)". The teachers do not add
the centre frame: that of the motion teacher is its target, so it would learn nothing.
Look-ahead: 5 frames. Beyond the ends of a clip, time runs backwards.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from quiver.model.blocks import RADIUS, WINDOW, conv
from quiver.model.config import NetworkConfig, flag, whole_number
from quiver.model.rivals.edges import restored_range

LEAST_VARIANCE = 1e-6  # of a channel of features, so that constant ones have a slope


@dataclass(frozen=True)
class StudentTeacherConfig(NetworkConfig):
    """Configuration of Student-Teacher; the defaults are the sizes of our specification."""

    width: int = 64  # channels
    blocks: int = 4  # residual blocks of each stage
    distil: bool = True  # False: no teachers; the student learns from the restored frames alone

    def __post_init__(self) -> None:
        """Raise `ValueError` for a value out of range."""
        whole_number("StudentTeacherConfig.width", self.width, 1, 1024)
        whole_number("StudentTeacherConfig.blocks", self.blocks, 0, 100)
        flag("StudentTeacherConfig.distil", self.distil)


class Features(NamedTuple):
    """What an encoder finds in eleven frames."""

    full: Tensor  # [N, width, H, W]
    half: Tensor  # [N, width, H/2, W/2]


class Taught(NamedTuple):
    """What a student or a teacher finds in eleven frames."""

    restored: Tensor  # [N, 1, H, W], the centre frame
    features: tuple[Tensor, ...]  # [N, width, H/2, W/2] of each encoder: motion and noise, or that of the teacher


class StudentTeacher(nn.Module):
    """The student for grey frames, with its teachers if it has any; only training calls these."""

    look_ahead: ClassVar[int] = RADIUS  # frames
    frames_in: ClassVar[int] = WINDOW  # of a window; the middle one is restored
    multiple: ClassVar[int] = 2  # px that divide height and width inside
    motion_teacher: "Teacher | None"
    noise_teacher: "Teacher | None"

    def __init__(self, config: StudentTeacherConfig | None = None) -> None:
        """Make the networks of a configuration; the specified sizes by default."""
        super().__init__()
        self.config = config = config or StudentTeacherConfig()
        self.student = Student(config)
        self.motion_teacher, self.noise_teacher = (Teacher(config) if config.distil else None for _ in range(2))

    def forward(self, frames: Tensor) -> Tensor:
        """[B, T, 1, H, W] of codes/(2^b - 1) -> restored [B, T, 1, H, W]; ValueError for another shape."""
        return restored_range(self, frames, 0, frames.shape[1])

    def windows(self, frames: Tensor) -> Tensor:
        """[B, T, 1, H, W], T >= 11, H and W even -> restored frames 5 ... T-6 [B, T-10, 1, H, W]."""
        starts = range(frames.shape[1] - WINDOW + 1)
        return torch.stack([self.student(frames[:, t : t + WINDOW, 0]).restored for t in starts], dim=1)


class Student(nn.Module):
    """Two encoders of the same noisy frames, and a decoder of both."""

    def __init__(self, config: StudentTeacherConfig) -> None:
        """Make the layers."""
        super().__init__()
        self.motion = Encoder(config)
        self.noise = Encoder(config)
        self.decoder = Decoder(config, encoders=2)

    def forward(self, frames: Tensor) -> Taught:
        """Eleven frames [N, 11, H, W] of codes/(2^b - 1), H and W even -> the restored centre frame and features."""
        found = [self.motion(frames), self.noise(frames)]
        restored = self.decoder(found) + frames[:, RADIUS : RADIUS + 1]
        return Taught(restored, tuple(features.half for features in found))


class Teacher(nn.Module):
    """One encoder and a decoder."""

    def __init__(self, config: StudentTeacherConfig) -> None:
        """Make the layers."""
        super().__init__()
        self.encoder = Encoder(config)
        self.decoder = Decoder(config, encoders=1)

    def forward(self, frames: Tensor) -> Taught:
        """Eleven frames [N, 11, H, W] as this teacher sees them, H and W even -> the centre frame and features."""
        features = self.encoder(frames)
        return Taught(self.decoder([features]), (features.half,))


class Encoder(nn.Module):
    """Finds features of eleven frames at full and at half size."""

    def __init__(self, config: StudentTeacherConfig) -> None:
        """Make the layers."""
        super().__init__()
        width = config.width
        self.full = nn.Sequential(conv(WINDOW, width, 3), nn.ReLU(), *_residual_blocks(config))
        self.down = nn.Sequential(conv(width, width, 3, stride=2), nn.ReLU(), *_residual_blocks(config))

    def forward(self, frames: Tensor) -> Features:
        """[N, 11, H, W], H and W even -> features."""
        full = self.full(frames)
        return Features(full, self.down(full))


class Decoder(nn.Module):
    """Makes one frame of the features of one or two encoders."""

    def __init__(self, config: StudentTeacherConfig, encoders: int) -> None:
        """Make the layers."""
        super().__init__()
        width = config.width
        self.up = nn.Sequential(
            *(conv(encoders * width, width, 3), nn.ReLU(), *_residual_blocks(config)),
            *(conv(width, 4 * width, 3), nn.PixelShuffle(2)),
        )
        self.leave = nn.Sequential(
            *(conv((1 + encoders) * width, width, 3), nn.ReLU(), *_residual_blocks(config), conv(width, 1, 3))
        )

    def forward(self, found: Sequence[Features]) -> Tensor:
        """Features of every encoder -> [N, 1, H, W]."""
        up = self.up(torch.cat([features.half for features in found], dim=1))
        return self.leave(torch.cat([up, *(features.full for features in found)], dim=1))


class ResidualBlock(nn.Module):
    """Two convolutions with ReLU between, added to the input."""

    def __init__(self, width: int) -> None:
        """Make the layers."""
        super().__init__()
        self.first = conv(width, width, 3)
        self.second = conv(width, width, 3)

    def forward(self, x: Tensor) -> Tensor:
        """[N, width, h, w] -> the same shape."""
        return x + self.second(F.relu(self.first(x)))


def distillation_loss(
    student: Taught, target: Tensor, motion: Tensor, noise: Tensor, weights: tuple[float, float] = (0.1, 0.1)
) -> Tensor:
    """Return the loss of the student, a float32 scalar: squared error, plus its distance from both teachers.

    `target` is the sharp centre frame [N, 1, H, W]; `motion` and `noise` are the features of the teachers
    [N, width, H/2, W/2], computed without gradients; `weights` are those of the two distances.
    """
    loss = F.mse_loss(student.restored.float(), target.float())
    for weight, own, wanted in zip(weights, student.features, (motion, noise), strict=True):
        loss = loss + weight * feature_distance(own, wanted)
    return loss


def feature_distance(a: Tensor, b: Tensor) -> Tensor:
    """Return the mean squared difference of features [N, C, h, w], each channel with mean 0 and variance 1."""
    return F.mse_loss(_standardised(a), _standardised(b))


def _standardised(features: Tensor) -> Tensor:
    # Scales and offsets of features are free; only their pattern is taught.
    x = features.float()
    variance, mean = torch.var_mean(x, dim=(2, 3), correction=0, keepdim=True)
    return (x - mean) / (variance + LEAST_VARIANCE).sqrt()


def _residual_blocks(config: StudentTeacherConfig) -> list[nn.Module]:
    return [ResidualBlock(config.width) for _ in range(config.blocks)]
