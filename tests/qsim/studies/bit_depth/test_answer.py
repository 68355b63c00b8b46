"""Tests the search for a wanted motion, optima at the edge of the tried depths, and the sentence."""

import json

import numpy as np
import pytest
from waves import wave_clip

from qsim.cli.program import main
from qsim.clip.motion_statistics import moving_mean
from qsim.studies.bit_depth import answer
from qsim.studies.bit_depth.clip_study import study
from qsim.studies.bit_depth.readout import MODELS, StudySettings


@pytest.mark.parametrize("seed", range(40))
def test_the_speed_is_found_for_any_scene(seed):
    """Random fields of flow: the motion reached is within 5 % of the wanted one, or the error names the nearest."""
    rng = np.random.default_rng(seed)
    length = rng.exponential(10 ** rng.uniform(-5, 2), 500) * (rng.random(500) < rng.uniform(0.01, 1))
    px = 10 ** rng.uniform(-0.5, 1.5)
    shown = []

    def motion(speed: float) -> float:
        shown.append(moving_mean(speed * length, 7) or 0.0)
        return shown[-1]

    reachable = [moving_mean(v * length, 7) or 0.0 for v in np.geomspace(1e-3, 1e3, 400)]
    nearest = min(reachable, key=lambda found: abs(found - px))
    if abs(nearest / px - 1) > 0.05:
        with pytest.raises(ValueError, match="cannot be reached"):
            answer.speed_for(px, motion, "scene")
        return
    speed, reached = answer.speed_for(px, motion, "scene")
    assert reached == pytest.approx(px, rel=0.05)
    assert moving_mean(speed * length, 7) == pytest.approx(reached, rel=1e-3)
    assert len(shown) <= 10


def test_still_scenes_and_motions_out_of_reach_are_refused():
    with pytest.raises(ValueError, match=r"wall: nothing in it moves, so px=3 cannot be reached; leave px= out"):
        answer.speed_for(3.0, lambda speed: 0.0, "wall")
    with pytest.raises(ValueError, match=r"snail: px=3 cannot be reached; speed factor 1000 gives 0.5 px"):
        answer.speed_for(3.0, lambda speed: 5e-4 * speed, "snail")


def test_a_clip_is_made_faster_by_whole_factors(clip, tmp_path, capsys):
    assert answer.step_for(14.0, clip) == (2, pytest.approx(14))
    with pytest.raises(ValueError, match="moves 7 px per 3-bit frame, and a clip can only be made faster"):
        answer.step_for(3.0, clip)
    still = wave_clip(tmp_path / "still", 8, 0)
    with pytest.raises(ValueError, match="nothing in it moves"):
        answer.step_for(3.0, still)
    assert main(["tradeoff", str(clip.path), "--px", "14", "--ppp", "0.65", "--bits", "1,2"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "--px 14: speed factor 2"
    assert lines[-1].startswith("at 14 px per 3-bit frame and 0.65 photons per plane, one frame, pixels that move: ")
    assert "; after restoring 1 bit, 2 bits are " in lines[-1]


def test_an_optimum_at_the_edge_is_marked(clip):
    """Dim and slow needs many bits; the sentence states the loss of the neighbours."""
    found = study(clip, StudySettings(bits=(1, 2), ppp=0.1, instants=4))
    assert answer.at_edge(found, "multibit") == ">="
    assert answer.marked(found, "multibit") == ">= 2"
    sentence = answer.answer(found)
    lost = found.best("multibit").psnr_db - next(row for row in found.rows if row.model == "multibit").psnr_db
    assert f"multibit >= 2 bits, 1 bit is {lost:.1f} dB worse (the deepest tried: try bits 1,...,4)" in sentence
    deep = study(clip, StudySettings(bits=(4, 5), ppp=30.0, instants=2))
    assert answer.at_edge(deep, "multibit") == "<="


def test_the_range_is_widened_until_the_best_is_inside(clip):
    notes = []
    found = answer.widened(clip, StudySettings(bits=(1, 2), ppp=0.65, instants=2), notes.append)
    assert len(notes) == len(found.bits) - 2
    edges = [answer.at_edge(found, model) for model in MODELS]
    assert ">=" not in edges or 2 ** (found.bits[-1] + 1) - 1 > len(clip) or found.bits[-1] == answer.WIDEST
    assert found.bits == tuple(range(1, found.bits[-1] + 1))
    assert len(found.bits) > 2


@pytest.mark.slow
def test_the_motion_of_a_scene_is_that_of_its_clip(tmp_path, capsys):
    """The motion is measured without rendering; the rendered clip has the same."""
    words = ["tradeoff", "fan", "--px", "3", "--ppp", "2", "--bits", "1,2", "--size", "24x32", "--frames", "16"]
    assert main([*words, "-o", str(tmp_path / "out"), "--json", "-q"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["px_asked"] == [3.0]
    assert found["motion_px_per_code_frame"] == pytest.approx(3.0, rel=0.1)
