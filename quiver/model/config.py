"""What a QUIVER network is made of: the published design, the preset `nano`, and the ablations of the paper."""

from dataclasses import asdict, dataclass, fields

# Least and largest value of each number: a configuration comes from a file, and a network is built before its weights
# are compared with it.
_WHOLE = {
    "channels": (2, 1024),
    "deformable_groups": (1, 1024),
    "deformable_kernel": (1, 15),
    "denoiser_growth": (1, 1024),
    "denoiser_passes": (1, 64),
    "flow_kernel": (1, 31),
    "flow_levels": (3, 10),
    "cell_blocks": (1, 64),
    "cell_growth": (1, 8192),
    "attention_width": (1, 2**16),
    "fold": (1, 16),
    "baseline": (0, 1024),
}
_REAL = {"attention_temperature": (-1e6, 1e6), "sweep": (0.0, 32.0)}
_FLAGS = ("lecun", "pre_denoiser", "flow", "multi_scale")
_OPTIONAL = ("cell_growth", "attention_width", "attention_temperature")  # may be None
_FLOW_LAYERS = 8  # at most, of one level


def whole_number(name: str, value: object, least: int, most: int) -> None:
    """`ValueError` unless the value is an integer in least ... most."""
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        raise ValueError(f"{name} must be a whole number from {least} to {most}, got {_short(value)}")


def _short(value: object) -> str:
    if isinstance(value, int) and abs(value) >= 10**30:
        return "a number of more than 30 digits"
    return repr(value)[:60]


@dataclass(frozen=True)
class Config:
    """A QUIVER network. The defaults are the published design at full width."""

    channels: int = 64  # the unit C of all widths
    deformable_groups: int = 16  # groups of channels with offsets of their own
    deformable_kernel: int = 3  # side of the deformable convolution; 1 = one learnt position per pixel
    denoiser_growth: int = 64  # channels added per dense layer of the pre-denoiser
    denoiser_passes: int = 5  # times its one block is passed
    flow_channels: tuple[int, ...] = (32, 64, 32, 16)  # widths of each flow level
    flow_kernel: int = 7
    flow_levels: int = 4  # of the pyramid, at least 3
    cell_blocks: int = 11  # residual dense blocks of the recurrent cell
    cell_growth: int | None = None  # channels added by their layers; None = 2C as published
    attention_width: int | None = None  # channels of the temporal attention; None = 44C as published
    attention_temperature: float | None = None  # start of a learnt factor on the logits; None = none, as published
    fold: int = 1  # side of the blocks of pixels that become channels before everything else (1 = none)
    baseline: int = 0  # width of an hourglass over the window whose picture is added to the output; 0 = none
    sweep: float = 0.0  # px/frame: the baseline aligns by the best velocity up to about this one; 0 = not
    lecun: bool = False  # start from normal weights of variance 1/fan-in (LeCun, as the paper says) and zero biases
    pre_denoiser: bool = True  # ablation: False feeds the noisy frames to both streams and to the flow
    flow: bool = True  # ablation: False aligns by the learnt offsets alone
    multi_scale: bool = True  # ablation: False makes a picture at full scale only

    def __post_init__(self) -> None:
        """`ValueError` for a value that no network of ours has."""
        for name, (least, most) in _WHOLE.items():
            value = getattr(self, name)
            if value is not None or name not in _OPTIONAL:
                whole_number(f"Config.{name}", value, least, most)
        for name, (low, high) in _REAL.items():
            value = getattr(self, name)
            if value is None and name in _OPTIONAL:
                continue
            if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
                raise ValueError(f"Config.{name} must be a number from {low:g} to {high:g}, got {_short(value)}")
        for name in _FLAGS:
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"Config.{name} must be true or false, got {_short(getattr(self, name))}")
        if not isinstance(self.flow_channels, tuple) or not 1 <= len(self.flow_channels) <= _FLOW_LAYERS:
            raise ValueError(
                f"Config.flow_channels must be 1 to {_FLOW_LAYERS} widths, got {_short(self.flow_channels)}"
            )
        for value in self.flow_channels:
            whole_number("Config.flow_channels", value, 1, 1024)
        if self.channels % 2 or self.channels % self.deformable_groups:
            raise ValueError(
                f"Config.channels must be even and a multiple of the {self.deformable_groups} deformable groups, "
                f"got {self.channels}"
            )
        for name in ("flow_kernel", "deformable_kernel"):
            if getattr(self, name) % 2 == 0:
                raise ValueError(f"Config.{name} must be odd, got {getattr(self, name)}")

    def to_dict(self) -> dict[str, object]:
        """Plain values, for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, object]) -> "Config":
        """Inverse of `to_dict`; ValueError for anything else."""
        names = {field.name for field in fields(cls)}
        if not isinstance(values, dict):
            raise ValueError(f"QUIVER Config is a table of values, got {_short(values)}")
        for name in values:
            if name not in names:
                raise ValueError(f"QUIVER Config has no field {name[:60]!r}; known: {', '.join(sorted(names))}")
        values = dict(values)
        if isinstance(values.get("flow_channels"), list):
            values["flow_channels"] = tuple(values["flow_channels"])  # type: ignore[arg-type]
        return cls(**values)  # type: ignore[arg-type]
