"""Tests that a study and a sweep are drawn as PNG."""

from qsim.studies.bit_depth.clip_study import study
from qsim.studies.bit_depth.clips import MovingClip
from qsim.studies.bit_depth.figures import study_figure, sweep_figure
from qsim.studies.bit_depth.readout import StudySettings
from qsim.studies.bit_depth.speed_sweep import sweep

SETTINGS = StudySettings(bits=(1, 2), ppp=0.65, instants=1)


def test_a_study_and_a_sweep_are_drawn_as_png(clip):
    found = study(clip, SETTINGS)
    assert study_figure(found).startswith(b"\x89PNG")
    swept = sweep([MovingClip(1.0, clip), MovingClip(2.0, clip, 2)], [0.3, 3.0], SETTINGS)
    assert sweep_figure(swept).startswith(b"\x89PNG")
