"""The configuration of QUIVER: its width, and the switches of the paper's ablation."""

from dataclasses import asdict, dataclass
from typing import Self

from qsim.checks import shown
from qsim.structure import make

GROUPS = 16  # groups of channels with offsets of their own in the published alignment


def whole_number(name: str, value: object, least: int, most: int) -> None:
    """`ValueError` unless the value is an integer in least ... most."""
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        raise ValueError(f"{name} must be a whole number from {least} to {most}, got {shown(value)}")


def real_number(name: str, value: object, low: float, high: float) -> None:
    """`ValueError` unless the value is a number in low ... high."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise ValueError(f"{name} must be a number from {low:g} to {high:g}, got {shown(value)}")


def flag(name: str, value: object) -> None:
    """`ValueError` unless the value is true or false."""
    if not isinstance(value, bool):
        raise ValueError(f"{name} must be true or false, got {shown(value)}")


@dataclass(frozen=True)
class Config:
    """A QUIVER network. The defaults are the published design at full width."""

    channels: int = 64  # the unit C of all widths
    cell_growth: int | None = None  # channels added by the layers of the recurrent cell; None = 2C as published
    pre_denoiser: bool = True  # ablation: False feeds the noisy frames to both streams and to the flow
    flow: bool = True  # ablation: False aligns by the learnt offsets alone
    multi_scale: bool = True  # ablation: False makes a picture at full scale only

    def __post_init__(self) -> None:
        """`ValueError` for a value that no network of ours has."""
        self.check(GROUPS)

    def check(self, groups: int) -> None:
        """`ValueError` for a value that no network with so many deformable groups has."""
        whole_number("Config.channels", self.channels, 2, 1024)
        if self.cell_growth is not None:
            whole_number("Config.cell_growth", self.cell_growth, 1, 8192)
        for name in ("pre_denoiser", "flow", "multi_scale"):
            flag(f"Config.{name}", getattr(self, name))
        if self.channels % 2 or self.channels % groups:
            raise ValueError(
                f"Config.channels must be even and a multiple of the {groups} deformable groups, got {self.channels}"
            )

    def to_dict(self) -> dict[str, object]:
        """Plain values, for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, object]) -> Self:
        """Inverse of `to_dict`; ValueError for anything else."""
        return make(cls, values, "QUIVER")
