"""Tests the ablation of the paper: Ctrl-C, light levels that stay apart, and clips of one scene that count once."""

from __future__ import annotations

import signal

import pytest

from qsim.cli.signals import handling
from quiver.cli.program import main
from quiver.evaluation.comparison import ComparisonRow
from quiver.evaluation.metrics import Score
from quiver.training import ablation
from quiver.training.ablation import markdown


def row(light: str, psnr: float, clip: str, scene: str) -> ComparisonRow:
    """A score of the network with all parts."""
    score = Score(psnr, psnr, 0.5, 0.5, scale=1.0, scale_spread=0.0, frames=3)
    return ComparisonRow("all", "", light, clip, scene, score)


def test_light_levels_have_lines_of_their_own():
    dim = row("A", 20.0, "fan", "fan")
    bright = row("B", 30.0, "fan", "fan")
    header, _, first, second = markdown("quiver-s", [dim, bright]).splitlines()
    assert header.split("|")[5].strip() == "light"
    assert first.endswith("| A | 20.00 dB | 0.500 |")
    assert second.endswith("| B | 30.00 dB | 0.500 |")
    assert "light" not in markdown("quiver-s", [dim])


def test_clips_of_one_scene_count_once():
    clips = [row("A", 20.0, "fan_0", "fan"), row("A", 22.0, "fan_1", "fan"), row("A", 31.0, "gears", "gears")]
    assert "| 26.00 dB |" in markdown("quiver-s", clips)


def test_a_network_without_a_score_failed():
    lost = ComparisonRow("all", "", "A", "fan", "fan", failure="ValueError: no")
    assert markdown("quiver-s", [lost]).endswith("| failed |  |\n")


@pytest.mark.parametrize("place", ["train", "evaluate"])
def test_ctrl_c_ends_training_and_scoring(tiny_dataset, tmp_path, monkeypatch, capsys, place):
    def stopped(*words: object, **options: object) -> list[ComparisonRow]:
        signal.raise_signal(signal.SIGINT)  # to this thread; os.kill may reach another one, later
        return []

    for name in ("train", "restorer", "evaluate"):
        monkeypatch.setattr(ablation, name, lambda *words, **options: [])
    monkeypatch.setattr(ablation, place, stopped)
    words = ["--steps", "1", "--crop", "16", "--threads", "1", "-q"]
    with handling(signal.default_int_handler, signal.SIGINT):  # a shell's background jobs ignore the signal
        assert main(["ablate", str(tiny_dataset), "-o", str(tmp_path / "six"), *words]) == 130
    assert "interrupted; the same command resumes" in capsys.readouterr().err
