"""A plain U-Net over the stacked frames of a window: the control that every learned method is measured against.

Eleven codes enter as channels, the centre frame leaves; nothing knows about motion, time or noise.
"""

from dataclasses import asdict, dataclass

import torch
from torch import Tensor, nn

from quiver.blocks import WINDOW, conv
from quiver.model import Output, check_input


@dataclass(frozen=True)
class UNetConfig:
    """Three scales with widths w, 2w, 4w; w = 32 gives 0.91 million parameters."""

    width: int = 32

    def __post_init__(self) -> None:
        if self.width < 1:
            raise ValueError(f"UNetConfig.width must be at least 1, got {self.width}")

    def to_dict(self) -> dict[str, object]:
        """Plain values, for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, object]) -> "UNetConfig":
        """Inverse of `to_dict`; ValueError for anything but a width."""
        if set(values) != {"width"}:
            raise ValueError(f"UNetConfig has the one field width, got {', '.join(sorted(values)) or 'none'}")
        return cls(int(str(values["width"])))


class UNet(nn.Module):
    """The same call as QUIVER; its output has scale 1 only."""

    multiple = 4

    def __init__(self, config: UNetConfig | None = None) -> None:
        super().__init__()
        self.config = config or UNetConfig()
        w = self.config.width
        self.down1 = _convolutions(WINDOW, w)
        self.down2 = _convolutions(w, 2 * w)
        self.bottom = _convolutions(2 * w, 4 * w, 5)
        self.up2 = nn.ConvTranspose2d(4 * w, 2 * w, 2, stride=2)
        self.merge2 = _convolutions(4 * w, 2 * w)
        self.up1 = nn.ConvTranspose2d(2 * w, w, 2, stride=2)
        self.merge1 = _convolutions(2 * w, w)
        self.leave = conv(w, 1, 3)
        self.pool = nn.MaxPool2d(2)

    def forward(self, x: Tensor) -> Output:
        """[B, T, 1, H, W] with T >= 11 -> Output for the frames 5 .. T-6; ValueError as for QUIVER."""
        check_input(x, self.multiple)
        windows = [self._window(x[:, t : t + WINDOW, 0]) for t in range(x.shape[1] - WINDOW + 1)]
        return Output(None, torch.stack(windows, dim=1), None, None)

    def _window(self, stack: Tensor) -> Tensor:
        a = self.down1(stack)
        b = self.down2(self.pool(a))
        c = self.bottom(self.pool(b))
        d = self.merge2(torch.cat((self.up2(c), b), dim=1))
        return self.leave(self.merge1(torch.cat((self.up1(d), a), dim=1)))


def _convolutions(inputs: int, outputs: int, count: int = 2) -> nn.Sequential:
    layers: list[nn.Module] = []
    for i in range(count):
        layers += [conv(outputs if i else inputs, outputs, 3), nn.ReLU()]
    return nn.Sequential(*layers)
