"""Holds the configuration of QUIVER: its width, the switches of the paper's ablation, and the sizes of some parts."""

from dataclasses import asdict, dataclass
from typing import Self

from qsim.checks import shown
from qsim.records import convert

FLOW_LAYERS = 8  # at most, of one level


def whole_number(name: str, value: object, least: int, most: int) -> None:
    """Raise `ValueError` unless the value is an integer in least ... most."""
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        raise ValueError(f"{name} must be a whole number from {least} to {most}, got {shown(value)}")


def real_number(name: str, value: object, low: float, high: float) -> None:
    """Raise `ValueError` unless the value is a number in low ... high."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise ValueError(f"{name} must be a number from {low:g} to {high:g}, got {shown(value)}")


def flag(name: str, value: object) -> None:
    """Raise `ValueError` unless the value is true or false."""
    if not isinstance(value, bool):
        raise ValueError(f"{name} must be true or false, got {shown(value)}")


class NetworkConfig:
    """The configuration of a network, a record whose fields a file of weights holds as JSON."""

    def to_dict(self) -> dict[str, object]:
        """Return plain values for JSON."""
        return asdict(self)  # type: ignore[call-overload]

    @classmethod
    def from_dict(cls, values: dict[str, object]) -> Self:
        """Return the configuration of such values; ValueError for unknown fields and values out of range."""
        return convert(values, cls, cls.__name__.removesuffix("Config") or "QUIVER")


@dataclass(frozen=True)
class Config(NetworkConfig):
    """Configuration of a QUIVER network; the defaults are the published design at full width."""

    channels: int = 64  # the unit C of all widths
    cell_growth: int | None = None  # channels that a layer of the recurrent cell adds; None = 2C as published
    pre_denoiser: bool = True  # ablation: False feeds the noisy frames to both streams and to the flow
    flow: bool = True  # ablation: False aligns by the learnt offsets alone
    multi_scale: bool = True  # ablation: False makes a picture at full scale only
    deformable_groups: int = 16  # of channels that share offsets in the alignment; they divide `channels`
    denoiser_growth: int = 64  # channels that a dense layer of the pre-denoiser adds
    flow_channels: tuple[int, ...] = (32, 64, 32, 16)  # widths of the layers of each flow level

    def __post_init__(self) -> None:
        """Raise `ValueError` for a value out of range."""
        whole_number("Config.channels", self.channels, 2, 1024)
        whole_number("Config.deformable_groups", self.deformable_groups, 1, 1024)
        whole_number("Config.denoiser_growth", self.denoiser_growth, 1, 1024)
        if self.cell_growth is not None:
            whole_number("Config.cell_growth", self.cell_growth, 1, 8192)
        for name in ("pre_denoiser", "flow", "multi_scale"):
            flag(f"Config.{name}", getattr(self, name))
        if not isinstance(self.flow_channels, tuple) or not 1 <= len(self.flow_channels) <= FLOW_LAYERS:
            found = shown(self.flow_channels)
            raise ValueError(f"Config.flow_channels must be 1 to {FLOW_LAYERS} widths, got {found}")
        for value in self.flow_channels:
            whole_number("Config.flow_channels", value, 1, 1024)
        if self.channels % 2 or self.channels % self.deformable_groups:
            raise ValueError(
                f"Config.channels must be even and a multiple of the {self.deformable_groups} deformable groups, "
                f"got {self.channels}"
            )
