"""What a QUIVER network is made of: the published design, the preset `nano`, and the ablations of the paper."""

from dataclasses import asdict, dataclass, fields


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
        if self.channels < 2 or self.channels % 2 or self.channels % self.deformable_groups:
            raise ValueError(
                f"Config.channels must be even and a multiple of the {self.deformable_groups} deformable groups, "
                f"got {self.channels}"
            )
        for name in ("denoiser_growth", "denoiser_passes", "cell_blocks", "fold", "flow_kernel"):
            if getattr(self, name) < 1:
                raise ValueError(f"Config.{name} must be at least 1, got {getattr(self, name)}")
        if self.flow_levels < 3:
            raise ValueError(f"Config.flow_levels must be at least 3, one for each scale, got {self.flow_levels}")
        for name in ("flow_kernel", "deformable_kernel"):
            if getattr(self, name) % 2 == 0:
                raise ValueError(f"Config.{name} must be odd, got {getattr(self, name)}")

    def to_dict(self) -> dict[str, object]:
        """Plain values, for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, object]) -> "Config":
        """Inverse of `to_dict`; ValueError for a field that does not exist."""
        names = {field.name for field in fields(cls)}
        for name in values:
            if name not in names:
                raise ValueError(f"QUIVER Config has no field {name!r}; known: {', '.join(sorted(names))}")
        values = dict(values)
        if "flow_channels" in values:
            values["flow_channels"] = tuple(values["flow_channels"])  # type: ignore[arg-type]
        return cls(**values)  # type: ignore[arg-type]


PRESETS: dict[str, Config] = {
    "quiver": Config(),
    "quiver-s": Config(channels=16),
    # Small in everything, on half of the pixels' side; an hourglass over the window, its frames aligned, learns in
    # minutes, the recurrent part can add to its picture. docs/results/starter.md has what it reaches.
    "nano": Config(
        channels=4,
        deformable_groups=1,
        deformable_kernel=1,  # sampling nine taps was the largest single cost
        denoiser_growth=4,
        denoiser_passes=1,
        flow_channels=(8, 8),
        flow_kernel=3,
        flow_levels=3,
        cell_blocks=1,
        attention_width=32,
        attention_temperature=8.0,
        fold=2,
        baseline=32,
        sweep=7.0,
        lecun=True,
    ),
}

# Rows of the paper's ablation (its Table 4, without the pretrained flow): pre-denoiser, flow, multi-scale outputs.
ABLATIONS: dict[str, tuple[bool, bool, bool]] = {
    "none": (False, False, False),
    "denoiser+flow": (True, True, False),
    "scales": (False, False, True),
    "flow+scales": (False, True, True),
    "denoiser+scales": (True, False, True),
    "all": (True, True, True),
}
