"""Holds the sizes at which all networks cost alike: about a million multiply-accumulates per pixel and frame.

Each is its published design with other widths. Counted by `quiver.evaluation.macs.design_macs`: one more frame of a
long clip, whose ends do not count.
"""

from typing import Any

from quiver.model.config import Config
from quiver.model.mergenet import MergeNetConfig
from quiver.model.rivals.bit2bit import Bit2BitConfig
from quiver.model.rivals.emvd import EMVDConfig
from quiver.model.rivals.fastdvdnet import FastDVDnetConfig
from quiver.model.rivals.flornn import FloRNNConfig
from quiver.model.rivals.memdeblur import MemDeblurConfig
from quiver.model.rivals.rvrt import RVRTConfig
from quiver.model.rivals.spk2imgnet import Spk2ImgNetConfig
from quiver.model.rivals.student_teacher import StudentTeacherConfig
from quiver.model.unet import UNetConfig

EQUAL_COST: dict[str, Any] = {
    "mergenet": MergeNetConfig(width=110),  # 0.99 M; merging, before it, has no convolutions
    "emvd": EMVDConfig(width=336),  # 0.99 M
    "flornn": FloRNNConfig(
        width=38, flow_channels=(16, 32, 16, 8)
    ),  # 1.02 M; the published flow network alone costs 0.6
    "memdeblur": MemDeblurConfig(width=112),  # 1.01 M
    "rvrt": RVRTConfig(width=168, flow_levels=4),  # 0.94 M; six levels pad a training crop to 132 px
    "spk2imgnet": Spk2ImgNetConfig(width=24),  # 1.06 M
    "student-teacher": StudentTeacherConfig(width=56),  # 1.00 M, of the student, which restores
    "bit2bit": Bit2BitConfig(width=40),  # 1.00 M; every frame lies in two pieces
    "fastdvdnet": FastDVDnetConfig(width=57),  # 0.99 M
    "unet": UNetConfig(width=90),  # 0.99 M
    # 1.02 M; the published width 16 costs 2.5
    "quiver-s": Config(channels=12, deformable_groups=12, denoiser_growth=24, flow_channels=(16, 32, 16, 8)),
}
