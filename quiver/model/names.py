"""Lists the networks by name, the one place that a new one is added to: its class, and what sets its preset apart.

Nothing here needs torch: commands read the names. `presets.py` makes the networks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Preset:
    """A network by name."""

    home: str  # module:class in quiver.model; the module has the configuration, too
    settings: Mapping[str, object] = field(default_factory=dict)  # of the configuration that are not at their defaults

    @property
    def compared(self) -> bool:
        """Whether it is a network of others, or the control."""
        return self.home.startswith(("rivals.", "unet:"))


_PUBLISHED = {
    "quiver-s": Preset("quiver:QUIVER", {"channels": 16}),
    "quiver": Preset("quiver:QUIVER"),
    "mergenet": Preset("mergenet:MergeNet"),
    "unet": Preset("unet:UNet"),
    "fastdvdnet": Preset("rivals.fastdvdnet:FastDVDnet"),
    "student-teacher": Preset("rivals.student_teacher:StudentTeacher"),
    "bit2bit": Preset("rivals.bit2bit:Bit2Bit"),
    "emvd": Preset("rivals.emvd:EMVD"),
    "flornn": Preset("rivals.flornn:FloRNN"),
    "memdeblur": Preset("rivals.memdeblur:MemDeblur"),
    "rvrt": Preset("rivals.rvrt:RVRT"),
    "spk2imgnet": Preset("rivals.spk2imgnet:Spk2ImgNet"),
}
# As their ports have them; the others are mended, with the sensor's noise or factor.
_AS_PUBLISHED: dict[str, dict[str, object]] = {
    "emvd": {},
    "flornn": {},
    "memdeblur": {"group_norm": False},
    "spk2imgnet": {},
}
# Sizes at which all networks cost alike: about a million multiply-accumulates per pixel and frame. Each is its
# published design with other widths. Counted by `quiver.evaluation.macs.design_macs`: one more frame of a long clip,
# whose ends do not count.
_EQUAL_COST: dict[str, dict[str, object]] = {
    # 1.02 M; the published width 16 costs 2.5
    "quiver-s": {"channels": 12, "deformable_groups": 12, "denoiser_growth": 24, "flow_channels": (16, 32, 16, 8)},
    "mergenet": {"width": 110},  # 0.99 M; merging, before it, has no convolutions
    "unet": {"width": 90},  # 0.99 M
    "fastdvdnet": {"width": 57},  # 0.99 M
    "student-teacher": {"width": 56},  # 1.00 M, of the student, which restores
    "bit2bit": {"width": 40},  # 1.00 M; every frame lies in two pieces
    "emvd": {"width": 336},  # 0.99 M
    "flornn": {"width": 38, "flow_channels": (16, 32, 16, 8)},  # 1.02 M; the published flow network alone costs 0.6
    "memdeblur": {"width": 112},  # 1.01 M
    "rvrt": {"width": 168, "flow_levels": 4},  # 0.94 M; six levels pad a training crop to 132 px
    "spk2imgnet": {"width": 24},  # 1.06 M
}
PRESETS: dict[str, Preset] = {
    **_PUBLISHED,
    **{
        f"{name}-as-published": Preset(_PUBLISHED[name].home, {"as_published": True, **settings})
        for name, settings in _AS_PUBLISHED.items()
    },
    **{f"{name}-1m": Preset(_PUBLISHED[name].home, settings) for name, settings in _EQUAL_COST.items()},
}

NETWORKS = tuple(PRESETS)
QUIVERS = tuple(name for name, preset in _PUBLISHED.items() if preset.home == "quiver:QUIVER")
COMPARED = tuple(name for name, preset in _PUBLISHED.items() if preset.compared)
EQUAL_COST = tuple(f"{name}-1m" for name in _EQUAL_COST)
