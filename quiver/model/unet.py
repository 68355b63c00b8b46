"""A plain U-Net over the stacked frames of a window: the control that every learned method is measured against.

Eleven codes enter as channels, the centre frame leaves; nothing knows about motion, time or noise.
"""

from dataclasses import asdict, dataclass

import torch
from torch import Tensor, nn

from quiver.model.blocks import WINDOW, Hourglass, Output, check_input
from quiver.model.config import whole_number


@dataclass(frozen=True)
class UNetConfig:
    """Three scales with widths w, 2w, 4w; w = 32 gives 0.91 million parameters."""

    width: int = 32

    def __post_init__(self) -> None:
        whole_number("UNetConfig.width", self.width, 1, 1024)

    def to_dict(self) -> dict[str, object]:
        """Plain values, for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, object]) -> "UNetConfig":
        """Inverse of `to_dict`; ValueError for anything but a width."""
        if not isinstance(values, dict) or set(values) != {"width"}:
            raise ValueError(f"UNetConfig has the one field width, got {', '.join(sorted(values))[:60] or 'none'}")
        return cls(values["width"])  # type: ignore[arg-type]  # checked there


class UNet(nn.Module):
    """The same call as QUIVER; its output has scale 1 only."""

    multiple = Hourglass.MULTIPLE
    reach = Hourglass.REACH  # px: what is farther away does not change a pixel

    def __init__(self, config: UNetConfig | None = None) -> None:
        super().__init__()
        self.config = config or UNetConfig()
        self.hourglass = Hourglass(WINDOW, self.config.width)

    def forward(self, x: Tensor) -> Output:
        """[B, T, 1, H, W] with T >= 11 -> Output for the frames 5 .. T-6; ValueError as for QUIVER."""
        check_input(x, self.multiple)
        windows = [self.hourglass(x[:, t : t + WINDOW, 0]) for t in range(x.shape[1] - WINDOW + 1)]
        return Output(None, torch.stack(windows, dim=1), None, None)
