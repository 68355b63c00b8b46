"""Defines MemDeblur, memory-based video deblurring (Ji and Yao, CVPR 2022): recurrent, at three scales.

    backward pass at full size -> forward passes at 1/4, 1/2 and full size; each frame sees the hidden state of its
    neighbour, and reads by attention what earlier frames stored: keys, restored images, hidden states

Written from a description of the article and of its port to 3-bit frames; the names of the layers are the port's.
Look-ahead: the whole clip, as the backward pass begins at its end. Hidden states and memories begin empty at both ends
of a clip; nothing is reflected.

Memory: features -> key (where), features and image, or features and hidden state -> value (what), both at a sixteenth
of the size; read: values weighted by the nearness of stored keys to the key of the frame -> decoded. In training a
memory keeps all that is written and attention is over all of it. In evaluation a query sees its 20 nearest entries, and
a memory keeps the latest five keys' worth. The mode of the network chooses.

Our reading: the three output channels share one target, so their mean is the restored frame. The article centres its
input at 0.5, the port does not; we do, and `as_published` does not. Nothing begins with weights of ImageNet. Batch
normalisation, as published, sees one frame at a time: a few values per channel in small crops, whose mean statistics do
not fit single frames afterwards. We normalise groups of channels of each frame instead; the preset
`memdeblur-as-published` keeps batch normalisation.
"""

import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from quiver.model.blocks import conv, join, resize, upsample
from quiver.model.config import NetworkConfig, flag, whole_number
from quiver.model.rivals.edges import check_frames, pad_space

IMAGE = 3  # channels of an image
MULTIPLE = 4  # px that divide height and width at every scale
SCALES = (4, 2, 1)  # the size of a scale is that of the frames divided by this
EVERY = (1, 2, 5)  # frames between two writes into the forward memory, per scale
BACKWARD_EVERY = 5  # frames between two writes into the backward memory
FEATURES = 48  # channels of a frame's features
NEAREST = 20  # entries that a query sees in evaluation
KEPT = 5  # times the positions of a key: what a memory keeps in evaluation
SLOPE = 0.1  # of every LeakyReLU


@dataclass(frozen=True)
class MemDeblurConfig(NetworkConfig):
    """Configuration of MemDeblur; the defaults are the published sizes."""

    width: int = 64  # hidden channels; all other sizes but the 48 features of a frame scale with it
    forward_blocks: int = 30
    backward_blocks: int = 10
    group_norm: bool = True  # in the memory's encoders; False: batch normalisation, as published
    as_published: bool = False  # input in 0 ... 1, not centred

    def __post_init__(self) -> None:
        """Raise `ValueError` for a value out of range."""
        whole_number("MemDeblurConfig.width", self.width, 8, 1024)
        if self.width % 8:
            raise ValueError(f"MemDeblurConfig.width must be a multiple of 8, got {self.width}")
        for name in ("forward_blocks", "backward_blocks"):
            whole_number(f"MemDeblurConfig.{name}", getattr(self, name), 0, 1024)
        for name in ("group_norm", "as_published"):
            flag(f"MemDeblurConfig.{name}", getattr(self, name))


class Clip(NamedTuple):
    """The frames of a clip at one scale."""

    images: list[Tensor]  # [B, 3, h, w] each
    features: list[Tensor]  # [B, 48, h/4, w/4]
    keys: list[Tensor]  # [B, width, h/16, w/16]


class Stored(NamedTuple):
    """What a memory holds, oldest first; n positions."""

    keys: Tensor  # [B, width, n]
    values: Tensor  # [B, V, n]


class MemDeblur(nn.Module):
    """MemDeblur for grey frames."""

    look_ahead: ClassVar[int | None] = None  # all frames
    unused: ClassVar[tuple[str, ...]] = ("conv_hr.", "conv_last.")

    def __init__(self, config: MemDeblurConfig | None = None) -> None:
        """Make the network of a configuration; the published sizes by default."""
        super().__init__()
        self.config = config = config or MemDeblurConfig()
        width = config.width
        self.downsampling = nn.Sequential(
            conv(IMAGE, IMAGE, 5), Down(IMAGE, width // 4), Down(4 * IMAGE, width * 3 // 8)
        )
        self.upsampling = nn.Sequential(
            *(upsample(width, width // 2), nn.LeakyReLU(SLOPE)),
            *(upsample(width // 2, width // 4), nn.LeakyReLU(SLOPE)),
            conv(width // 4, IMAGE, 5),
        )
        inputs = 2 * FEATURES + 4 * width
        self.forward_input_convs = nn.ModuleList(
            nn.Sequential(conv(inputs + (FEATURES if scale else 0), width, 3), nn.LeakyReLU(SLOPE))
            for scale in range(len(SCALES))
        )
        self.forward_resblocks = nn.ModuleDict({"main": nn.Sequential(residual_blocks(width, config.forward_blocks))})
        self.backward_resblocks = Trunk(2 * FEATURES + 2 * width, width, config.backward_blocks)
        self.fusion = conv(2 * width, width, 1)
        self.memory = Memory(width, config.group_norm)

    def forward(self, frames: Tensor) -> Tensor:
        """[B, T, 1, H, W] of codes/(2^b - 1) -> restored [B, T, 1, H, W]; ValueError for another shape."""
        check_frames(frames)
        images = self.images(pad_space(frames, MULTIPLE))
        restored = self.scales(images)[-1].mean(dim=2, keepdim=True) + self.centre
        return restored[..., : frames.shape[-2], : frames.shape[-1]]

    @property
    def centre(self) -> float:
        """What is taken from the frames, and added to the result."""
        return 0.0 if self.config.as_published else 0.5

    def images(self, frames: Tensor) -> Tensor:
        """Frames [B, T, 1, H, W] -> images [B, T, 3, H, W] as the network takes them."""
        return (frames - self.centre).expand(-1, -1, IMAGE, -1, -1)

    def scales(self, images: Tensor) -> list[Tensor]:
        """Images [B, T, 3, H, W], sides multiples of 4 -> restored images at 1/4, 1/2 and full size.

        The size of a scale is rounded down to pixels, then up to a multiple of 4.
        """
        self._check_statistics(images)
        full = self._clip(list(images.unbind(1)))
        behind, backward = self._backward_pass(full)
        outputs: list[Tensor] | None = None
        stored = None
        results = []
        for scale, divisor in enumerate(SCALES):
            clip = full if divisor == 1 else self._clip([resize(x, *_size(x, divisor)) for x in full.images])
            outputs, stored = self._forward_pass(scale, clip, outputs, behind, backward, stored)
            results.append(torch.stack(outputs, dim=1))
        return results

    def _check_statistics(self, images: Tensor) -> None:
        """Raise `ValueError` if batch normalisation in training would see one value per channel."""
        learns = not self.config.group_norm and self.memory.key_encoder.bn1.training
        if learns and len(images) == 1 and max(_size(images, SCALES[0])) <= 16:
            raise ValueError(
                f"a batch of one clip of {images.shape[-2]} x {images.shape[-1]} px leaves batch normalisation one "
                "value per channel; take sides above 64 px, more clips, or group_norm"
            )

    def _clip(self, images: list[Tensor]) -> Clip:
        features = [self.downsampling(image) for image in images]
        return Clip(images, features, [self.memory.key(feature) for feature in features])

    def _backward_pass(self, clip: Clip) -> tuple[list[Tensor], Stored]:
        """Hidden states [B, width, h/4, w/4] of all frames, from the last to the first, and what was stored."""
        last = len(clip.images) - 1
        states: list[Tensor] = []
        stored: Stored | None = None
        for i in range(last, -1, -1):
            feature = clip.features[i]
            key = clip.keys[i]
            if stored is None:
                past = [_zeros(feature, FEATURES + 2 * self.config.width)]
            else:
                read = self.memory.decode_feature(self.memory.read(stored, key), feature)
                past = [clip.features[i + 1], read, states[-1]]
            states.append(self.backward_resblocks(join(feature, *past)))
            written = (last - i) % BACKWARD_EVERY == 0 if self.training else i % BACKWARD_EVERY == 2
            if stored is None or written:
                stored = self.memory.write(stored, key, self.memory.value_encoder_feat(join(feature, states[-1])))
        assert stored is not None
        return states[::-1], stored

    def _forward_pass(
        self,
        scale: int,
        clip: Clip,
        coarser: list[Tensor] | None,
        behind: list[Tensor],
        backward: Stored,
        stored: Stored | None,
    ) -> tuple[list[Tensor], Stored]:
        """Restored images of a scale, and the forward memory after it, which holds those of all scales."""
        memory = self.memory
        outputs = []
        hidden: Tensor | None = None
        for i, (image, feature, key) in enumerate(zip(*clip, strict=True)):
            parts = [feature, memory.decode_feature(memory.read(backward, key), feature)]
            if coarser is not None:
                parts.append(self.downsampling(resize(coarser[i], *image.shape[-2:])))
            if stored is None or hidden is None:
                parts.append(_zeros(feature, FEATURES + 3 * self.config.width))
            else:
                of_features, of_images = memory.read(stored, key).chunk(2, dim=1)
                parts += [
                    clip.features[i - 1],
                    memory.decode_feature(of_features, feature),
                    hidden,
                    memory.decode_image(of_images, feature),
                ]
            hidden = self.forward_resblocks["main"](self.forward_input_convs[scale](join(*parts)))
            fused = self.fusion(join(resize(behind[i], *feature.shape[-2:]), hidden))
            outputs.append(self.upsampling(F.leaky_relu(fused, SLOPE)) + image)
            if i % EVERY[scale] == 0:
                image_value = memory.value_encoder_mem(join(feature, self.downsampling(outputs[-1])))
                feature_value = memory.value_encoder_feat(join(feature, hidden))
                stored = memory.write(stored, key, join(feature_value, image_value))
        assert stored is not None
        return outputs, stored


class Down(nn.Module):
    """A residual dense block, then half the size and four times the channels."""

    def __init__(self, channels: int, growth: int) -> None:
        """Make the layers."""
        super().__init__()
        self.rdb = nn.ModuleDict(
            {
                "dense_layers": nn.ModuleList(
                    nn.ModuleDict({"conv": conv(channels + i * growth, growth, 3)}) for i in range(3)
                ),
                "conv1x1": conv(channels + 3 * growth, channels, 1),
            }
        )
        self.down_sampling = conv(channels, 4 * channels, 5, stride=2)

    def forward(self, x: Tensor) -> Tensor:
        """[B, channels, h, w] -> [B, 4 channels, h/2, w/2]."""
        y = x
        for layer in self.rdb["dense_layers"].children():
            y = join(y, F.relu(layer.get_submodule("conv")(y)))
        return self.down_sampling(self.rdb["conv1x1"](y) + x)


def _zeros(like: Tensor, channels: int) -> Tensor:
    return like.new_zeros(len(like), channels, *like.shape[2:])


def _size(images: Tensor, divisor: int) -> tuple[int, int]:
    """Height and width at a scale: rounded down to pixels, then up to a multiple of 4."""
    height, width = (-(side // divisor) // MULTIPLE * -MULTIPLE for side in images.shape[-2:])
    return height, width


# ---- Memory


class Memory(nn.Module):
    """Makes keys and values, stores them, and reads them by attention."""

    def __init__(self, width: int, group_norm: bool) -> None:
        """Make the layers."""
        super().__init__()
        self.key_encoder = Encoder(FEATURES, width * 3 // 4, width, group_norm)
        self.value_encoder_mem = Encoder(2 * FEATURES, width // 2, width, group_norm)
        self.value_encoder_feat = Encoder(FEATURES + width, width // 2, width, group_norm)
        projection = conv(4 * width, width, 3)
        self.key_proj = nn.ModuleDict({"key_proj": projection})
        self.decoder_mem = Decoder(width)
        self.decoder_feat = Decoder(width)
        self.attention = Attention()
        # As in STCN (Cheng, Tai and Tang, NeurIPS 2021), whose memory this is.
        nn.init.orthogonal_(projection.weight)
        nn.init.zeros_(projection.get_parameter("bias"))

    def key(self, feature: Tensor) -> Tensor:
        """Features [B, 48, h, w] -> key [B, width, h/4, w/4]."""
        return self.key_proj["key_proj"](self.key_encoder(feature))

    def read(self, stored: Stored, query: Tensor) -> Tensor:
        """Query [B, width, h, w] -> values [B, V, h, w]."""
        return self.attention(stored, query)

    def write(self, stored: Stored | None, key: Tensor, value: Tensor) -> Stored:
        """Append a key [B, width, h, w] and its values [B, V, h, w]; in evaluation drop the oldest entries."""
        new = Stored(key.flatten(2), value.flatten(2))
        if stored is None:
            return new
        kept = 0 if self.training else KEPT * new.keys.shape[2]
        both = [torch.cat(pair, dim=2)[..., -kept:] for pair in zip(stored, new, strict=True)]
        return Stored(*both)

    def decode_image(self, values: Tensor, like: Tensor) -> Tensor:
        """Image values [B, 4 width, h/4, w/4] -> [B, width, h, w], the size of `like`."""
        return self.decoder_mem(values)[..., : like.shape[-2], : like.shape[-1]]

    def decode_feature(self, values: Tensor, like: Tensor) -> Tensor:
        """Feature values [B, 4 width, h/4, w/4] -> [B, width, h, w], the size of `like`."""
        return self.decoder_feat(values)[..., : like.shape[-2], : like.shape[-1]]


class Attention(nn.Module):
    """Reads a memory: nearer keys weigh more. It has no parameters, and is in float32 at least, also under autocast."""

    def forward(self, stored: Stored, query: Tensor) -> Tensor:
        """Query [B, width, h, w] -> values [B, V, h, w]."""
        with torch.autocast(query.device.type, enabled=False):
            dtype = torch.promote_types(query.dtype, torch.float32)
            keys, values = (x.to(dtype) for x in stored)
            queries = query.flatten(2).to(dtype)
            # -|k - q|^2 without |q|^2, which is the same for all keys of a query, and which softmax ignores.
            nearness = 2 * keys.mT @ queries - keys.square().sum(dim=1)[..., None]
            nearness = nearness / math.sqrt(keys.shape[1])  # [B, n, h w]
            if not self.training and nearness.shape[1] > NEAREST:
                best = nearness.topk(NEAREST, dim=1)
                nearness = nearness.fill_(-torch.inf).scatter_(1, best.indices, best.values)  # no copy: it is large
            return (values @ nearness.softmax(dim=1)).unflatten(2, query.shape[2:])


class Encoder(nn.Module):
    """Features to keys or values at a quarter of their size: a trunk, then the first stage of a ResNet-50."""

    def __init__(self, inputs: int, channels: int, width: int, group_norm: bool) -> None:
        """Make the layers."""
        super().__init__()
        self.forward_resblocks = Trunk(inputs, channels, 2)
        self.conv1 = conv(channels, width, 7, stride=2)
        self.bn1 = _norm(group_norm, width)
        self.layer1 = nn.Sequential(*(Bottleneck(4 * width if i else width, width, group_norm) for i in range(3)))

    def forward(self, x: Tensor) -> Tensor:
        """[B, inputs, h, w] -> [B, 4 width, h/4, w/4], sides rounded up."""
        x = F.relu(self.bn1(self.conv1(self.forward_resblocks(x))))
        return self.layer1(F.max_pool2d(x, 3, stride=2, padding=1))


class Bottleneck(nn.Module):
    """A residual block of three convolutions with normalisation."""

    def __init__(self, inputs: int, width: int, group_norm: bool) -> None:
        """Make the layers; where the channels differ, the shortcut has a convolution."""
        super().__init__()
        outputs = 4 * width
        self.conv1 = conv(inputs, width, 1)
        self.bn1 = _norm(group_norm, width)
        self.conv2 = conv(width, width, 3)
        self.bn2 = _norm(group_norm, width)
        self.conv3 = conv(width, outputs, 1)
        self.bn3 = _norm(group_norm, outputs)
        shortcut = [] if inputs == outputs else [conv(inputs, outputs, 1), _norm(group_norm, outputs)]
        self.downsample = nn.Sequential(*shortcut)

    def forward(self, x: Tensor) -> Tensor:
        """[B, inputs, h, w] -> [B, 4 width, h, w]."""
        y = F.relu(self.bn1(self.conv1(x)))
        y = F.relu(self.bn2(self.conv2(y)))
        return F.relu(self.downsample(x) + self.bn3(self.conv3(y)))


class Decoder(nn.Module):
    """Values to features at four times their size."""

    def __init__(self, width: int) -> None:
        """Make the layers."""
        super().__init__()
        self.forward_resblocks = Trunk(4 * width, width, 2)
        self.upsample = nn.Sequential(conv(width, 16 * width, 3))

    def forward(self, x: Tensor) -> Tensor:
        """[B, 4 width, h, w] -> [B, width, 4h, 4w]."""
        y = self.forward_resblocks(x)
        return F.pixel_shuffle(self.upsample(y), 4) + resize(y, 4 * y.shape[-2], 4 * y.shape[-1])


class Trunk(nn.Module):
    """A convolution and residual blocks."""

    def __init__(self, inputs: int, width: int, count: int) -> None:
        """Make the layers."""
        super().__init__()
        self.main = nn.Sequential(conv(inputs, width, 3), nn.LeakyReLU(SLOPE), residual_blocks(width, count))

    def forward(self, x: Tensor) -> Tensor:
        """[B, inputs, h, w] -> [B, width, h, w]."""
        return self.main(x)


class ResidualBlock(nn.Module):
    """Two convolutions, added to their input; they begin small."""

    def __init__(self, width: int) -> None:
        """Make the layers."""
        super().__init__()
        self.conv1 = conv(width, width, 3)
        self.conv2 = conv(width, width, 3)
        for layer in (self.conv1, self.conv2):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            layer.weight.data.mul_(0.1)
            nn.init.zeros_(layer.get_parameter("bias"))

    def forward(self, x: Tensor) -> Tensor:
        """[B, width, h, w] -> the same shape."""
        return x + self.conv2(F.relu(self.conv1(x)))


def residual_blocks(width: int, count: int) -> nn.Sequential:
    """Return a chain of residual blocks [B, width, h, w] -> the same shape."""
    return nn.Sequential(*(ResidualBlock(width) for _ in range(count)))


def _norm(group_norm: bool, channels: int) -> nn.Module:
    return nn.GroupNorm(math.gcd(8, channels // 2), channels) if group_norm else nn.BatchNorm2d(channels)
