"""Defines the memory of MemDeblur: what it stores of a frame, and how a later frame reads it by attention.

    features -> key (where), features and image, or features and hidden state -> value (what), both at a sixteenth
    of the size; read: values weighted by the nearness of stored keys to the key of the frame -> decoded

In training a memory keeps all that is written and attention is over all of it. In evaluation a query sees its 20
nearest entries, and a memory keeps the latest five keys' worth. The mode of the network chooses.
"""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from quiver.model.blocks import conv, resize

FEATURES = 48  # channels of a frame's features
NEAREST = 20  # entries that a query sees in evaluation
KEPT = 5  # times the positions of a key: what a memory keeps in evaluation
SLOPE = 0.1


class Stored(NamedTuple):
    """What a memory holds, oldest first; n positions."""

    keys: Tensor  # [B, width, n]
    values: Tensor  # [B, V, n]


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
        self.decoder_mem, self.decoder_feat = Decoder(width), Decoder(width)
        self.attention = Attention()
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
        self.conv1, self.bn1 = conv(inputs, width, 1), _norm(group_norm, width)
        self.conv2, self.bn2 = conv(width, width, 3), _norm(group_norm, width)
        self.conv3, self.bn3 = conv(width, outputs, 1), _norm(group_norm, outputs)
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
        self.conv1, self.conv2 = conv(width, width, 3), conv(width, width, 3)
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
