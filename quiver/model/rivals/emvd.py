"""Defines EMVD, efficient multi-stage video denoising (Maggioni et al., CVPR 2021): tiny, causal, recurrent.

    frame in four channels -> learnt colour and wavelet transforms at three scales -> per scale, coarse to fine:
    fuse with the state (gamma), denoise, pass up -> at the finest scale refine (omega) -> inverse transforms

Written from a description of the article and of its port to 3-bit frames; the names of the layers are the port's.
Look-ahead: none. The first frame is its own past; the end of a clip needs nothing.

Our reading: the four output channels share one target, so their mean is the restored frame. The published port tells
the network the noise of a 12-bit camera, about a thousandth of the true one. To find it, it clips the low-pass bands at
1, though they carry gains of 4, 8 and 16. Here the noise is that of the sensor's table (noise.py), and the bands are
not clipped; a slip in one colour coefficient is mended too. `as_published` brings all three back.
"""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from quiver.model.config import NetworkConfig, flag, whole_number
from quiver.model.rivals.edges import check_frames, pad_space
from quiver.model.rivals.noise import numbers, table_of, variance_at

IMAGE = 4  # channels of an image
BANDS = 4  # blocks of a wavelet transform, each with the channels of an image
SCALES = 3


@dataclass(frozen=True)
class EMVDConfig(NetworkConfig):
    """Configuration of EMVD; the defaults are the published sizes, and the noise that the sensor has."""

    width: int = 16  # hidden channels of the small networks
    space_to_depth: bool = False  # ours: 2 x 2 pixels make four channels at half the size, instead of four copies
    as_published: bool = False  # the port's noise and colour coefficient
    published_noise: tuple[float, ...] = (1 / 3855, 1 / 3855**2)  # slope and offset, if as_published

    def __post_init__(self) -> None:
        """Raise `ValueError` for a value out of range."""
        whole_number("EMVDConfig.width", self.width, 1, 1024)
        for name in ("space_to_depth", "as_published"):
            flag(f"EMVDConfig.{name}", getattr(self, name))
        published = numbers("EMVDConfig.published_noise", self.published_noise, 2, 2)
        object.__setattr__(self, "published_noise", published)


class Fused(NamedTuple):
    """What a scale makes of the state and the new frame."""

    gamma: Tensor  # [N, 1, h, w] weight of the new frame, 0 ... 1
    fused: Tensor  # [N, 16, h, w] bands
    variance: Tensor  # [N, 1, h, w] of the fused low-pass band, in its units
    denoised: Tensor  # [N, 16, h, w] bands


class EMVD(nn.Module):
    """EMVD for grey frames: a step takes the state and a frame, and returns the restored frame and the next state."""

    look_ahead: ClassVar[int] = 0  # frames
    unused: ClassVar[tuple[str, ...]] = ()

    def __init__(self, config: EMVDConfig | None = None) -> None:
        """Make the network of a configuration; the published sizes by default."""
        super().__init__()
        self.config = config = config or EMVDConfig()
        self.multiple = 2**SCALES * (2 if config.space_to_depth else 1)  # px that divide height and width inside
        self.takes_variance = not config.as_published
        colour = _colour(0.2764 if config.as_published else 0.2784)
        self.ct = Colour(colour)
        self.cti = Colour(colour.T)
        self.ft = Analysis()
        self.fti = Synthesis()
        self.vd, self.md1, self.md0 = (Scale(config, scale) for scale in (2, 1, 0))
        self.refine = SmallNet(2 * BANDS * IMAGE + 1, config.width, 1, sigmoid=True)

    def forward(self, frames: Tensor, variance: Tensor | None = None) -> Tensor:
        """[B, T, 1, H, W] of codes/(2^b - 1) -> restored [B, T, 1, H, W]; ValueError for another shape.

        `variance` is the sensor's table, [n] or one per clip [B, n]; None: that of noise.VARIANCE.
        """
        check_frames(frames)
        table = table_of(variance, frames)
        state = None
        restored = []
        for image in self.packed(pad_space(frames, self.multiple)).unbind(1):
            output, state = self.step(state, image, table)
            restored.append(self.unpacked(output))
        return torch.stack(restored, dim=1)[..., : frames.shape[-2], : frames.shape[-1]]

    def packed(self, frames: Tensor) -> Tensor:
        """[B, T, 1, H, W] -> images [B, T, 4, h, w]; h, w = H, W or half of them."""
        if self.config.space_to_depth:
            return F.pixel_unshuffle(frames, 2)
        return frames.expand(-1, -1, IMAGE, -1, -1)

    def unpacked(self, image: Tensor) -> Tensor:
        """Image [B, 4, h, w] -> frame [B, 1, H, W]."""
        if self.config.space_to_depth:
            return F.pixel_shuffle(image, 2)
        return image.mean(dim=1, keepdim=True)

    def step(self, state: Tensor | None, image: Tensor, table: Tensor) -> tuple[Tensor, Tensor]:
        """Image [N, 4, h, w], noise table [N, n] -> (restored image, next state); the first state is None.

        Height and width must be multiples of 8. The next state is the fused image, not the restored one.
        """
        old, new = (self.bands(image if x is None else x) for x in (state, image))
        gamma = None
        up = None
        for scale, module in zip((2, 1, 0), (self.vd, self.md1, self.md0), strict=True):
            result = module(old[scale], new[scale], table, gamma, up)
            gamma = result.gamma
            if scale:
                up = self.fti(result.denoised)
        # The last step weighs what was fused against what was denoised, pixel by pixel.
        omega = self.refine(torch.cat([result.fused, result.denoised, result.variance], dim=1))
        refined = torch.lerp(result.denoised, result.fused, omega)
        return self.cti(self.fti(refined)), self.cti(self.fti(result.fused))

    def bands(self, image: Tensor) -> list[Tensor]:
        """Image [N, 4, h, w] -> its bands [N, 16, h/2, w/2], and those of the low-pass band twice more."""
        result = []
        low = self.ct(image)
        for _ in range(SCALES):
            result.append(self.ft(low))
            low = result[-1][:, :IMAGE]
        return result


class Scale(nn.Module):
    """Fuses and denoises the bands of one scale: 2 is the coarsest, 0 the finest."""

    def __init__(self, config: EMVDConfig, scale: int) -> None:
        """Make the two networks of a scale; the coarsest has no result from a coarser one."""
        super().__init__()
        coarser = scale < SCALES - 1
        bands = BANDS * IMAGE
        self.noise = NoiseMap(config, scale)
        self.fusion = SmallNet(IMAGE + 1 + coarser, config.width, 1, sigmoid=True)
        self.denoise = SmallNet(bands + IMAGE + 1 + IMAGE * coarser, config.width, bands)

    def forward(self, old: Tensor, new: Tensor, table: Tensor, gamma: Tensor | None, up: Tensor | None) -> Fused:
        """Bands of state and new frame [N, 16, h, w], coarser gamma [N, 1, h/2, w/2], its image `up` [N, 4, h, w]."""
        old_low = old[:, :IMAGE]
        new_low = new[:, :IMAGE]
        old_noise = self.noise(old_low, table)
        new_noise = self.noise(new_low, table)
        coarser = [] if gamma is None else [gamma.repeat_interleave(2, dim=-1).repeat_interleave(2, dim=-2)]
        gamma = self.fusion(torch.cat([(new_low - old_low).abs(), *coarser, new_noise], dim=1))
        fused = torch.lerp(old, new, gamma)
        # Independent noise of two frames, mixed by gamma: squares of the weights.
        variance = (1 - gamma) ** 2 * old_noise + gamma**2 * new_noise
        images = [] if up is None else [up]
        return Fused(gamma, fused, variance, self.denoise(torch.cat([fused, *images, new_low, variance], dim=1)))


class NoiseMap(nn.Module):
    """The variance of the low-pass band of one scale, from its own brightness."""

    def __init__(self, config: EMVDConfig, scale: int) -> None:
        """Keep the factors of the band, or the published constants."""
        super().__init__()
        self.as_published = config.as_published
        self.slope, self.offset = config.published_noise
        self.gain = 4.0 * 2**scale  # of the low-pass band: two by colour, two by every transform
        self.correlation = 1.0 if config.space_to_depth else 4.0  # copies add up to a larger variance

    def forward(self, low: Tensor, table: Tensor) -> Tensor:
        """Low-pass band [N, 4, h, w], noise table [N, n] -> variance [N, 1, h, w]."""
        brightness = low[:, :1]
        if self.as_published:
            return brightness.clamp(0, 1) * self.slope + self.offset
        return (self.correlation * variance_at(brightness / self.gain, table)).to(low.dtype)


class SmallNet(nn.Module):
    """Three 3 x 3 convolutions with ReLU between; a sigmoid at the end where the result is a weight."""

    def __init__(self, inputs: int, width: int, outputs: int, *, sigmoid: bool = False) -> None:
        """Make the layers."""
        super().__init__()
        self.net1 = nn.Conv2d(inputs, width, 3, padding=1)
        self.net2 = nn.Conv2d(width, width, 3, padding=1)
        self.net3 = nn.Conv2d(width, outputs, 3, padding=1)
        self.sigmoid = sigmoid

    def forward(self, x: Tensor) -> Tensor:
        """[N, inputs, h, w] -> [N, outputs, h, w]."""
        x = self.net3(F.relu(self.net2(F.relu(self.net1(x)))))
        return torch.sigmoid(x) if self.sigmoid else x


class Colour(nn.Module):
    """A learnt mix of the four channels."""

    def __init__(self, matrix: Tensor) -> None:
        """Begin with the matrix [4, 4]."""
        super().__init__()
        self.net1 = nn.Conv2d(IMAGE, IMAGE, 1, bias=False)
        self.net1.weight.data.copy_(matrix[..., None, None])

    def forward(self, image: Tensor) -> Tensor:
        """[N, 4, h, w] -> [N, 4, h, w]."""
        return self.net1(image)


class Analysis(nn.Module):
    """A wavelet transform with two learnt taps for low and for high frequencies, along x, then along y."""

    def __init__(self) -> None:
        """Begin with the transform of Haar."""
        super().__init__()
        self.net1 = nn.ParameterDict({"weight": _haar().view(2, 1, 1, 2)})

    def forward(self, image: Tensor) -> Tensor:
        """[N, 4, h, w] -> bands [N, 16, h/2, w/2]: (x low, y low), (low, high), (high, low), (high, high)."""
        taps = self.net1["weight"].view(2, 2)
        halves = [image[..., 0::2] * low + image[..., 1::2] * high for low, high in taps]
        return torch.cat([h[..., 0::2, :] * low + h[..., 1::2, :] * high for h in halves for low, high in taps], dim=1)


class Synthesis(nn.Module):
    """The inverse transform with its own taps, along y, then along x."""

    def __init__(self) -> None:
        """Begin with the inverse of Haar's transform."""
        super().__init__()
        low, high = _haar()
        self.net1 = nn.ParameterDict({"weight": low.view(1, 1, 2, 1).clone()})
        self.net2 = nn.ParameterDict({"weight": high.view(1, 1, 2, 1).clone()})

    def forward(self, bands: Tensor) -> Tensor:
        """Bands [N, 4c, h, w] -> [N, c, 2h, 2w]."""
        low_low, low_high, high_low, high_high = bands.chunk(BANDS, dim=1)
        low = self.joined(low_low, low_high, -2)
        high = self.joined(high_low, high_high, -2)
        return self.joined(low, high, -1)

    def joined(self, low: Tensor, high: Tensor, axis: int) -> Tensor:
        """Low and high band [..., n] of one axis -> [..., 2n]: places 0, 2 ... and 1, 3 ... interleaved."""
        low_taps = self.net1["weight"].flatten()
        high_taps = self.net2["weight"].flatten()
        parts = [low * low_taps[k] + high * high_taps[k] for k in (0, 1)]
        end = low.ndim + axis
        return torch.stack(parts, dim=end + 1).flatten(end, end + 1)


def _haar() -> Tensor:
    tap = 2**-0.5
    return torch.tensor([[tap, tap], [tap, -tap]])


def _colour(last: float) -> Tensor:
    rows = [(0.5, 0.5, 0.5, 0.5), (-0.5, 0.5, 0.5, -0.5), (0.65, 0.2784, -0.2784, -0.65), (-0.2784, 0.65, -0.65, last)]
    return torch.tensor(rows)
