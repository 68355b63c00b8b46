"""The program that compares found with true motion: true flow aligns frames, and mistakes are one line."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from qsim.keys import Key
from qsim.sensor.qis import QIS
from quiver.baselines.domain_tables import domain_tables
from quiver.baselines.information_domain import information_domain

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))

import restorer_motion  # noqa: E402  (benchmarks are not a package)

EXPOSURE = 5e-4
SENSOR = QIS(0.8, 1.6, 0.2, 7)


@dataclass
class Panning:
    """A texture that moves by the same flow (right, down) in every frame."""

    step: tuple[float, float]
    size: tuple[int, int] = (48, 64)

    def flow(self, t: int) -> np.ndarray:
        return np.broadcast_to(np.float32(self.step)[:, None, None], (2, *self.size)).copy()

    def flow_back(self, t: int) -> np.ndarray:
        return -self.flow(t)

    def valid(self, t: int) -> np.ndarray:
        return np.ones(self.size, bool)

    def holds(self, channel: str) -> bool:
        return False


def test_true_moves_lead_forwards_and_backwards():
    moves = restorer_motion.true_moves(Panning((2.0, -1.0)), 6, 5)
    assert sorted(moves) == [k for k in range(-5, 6) if k]
    for k, move in moves.items():
        np.testing.assert_allclose(move[0, :, 24, 32], (-1.0 * k, 2.0 * k))


def test_frames_are_aligned_by_their_true_flow():
    rng = np.random.default_rng(0)
    texture = 20 * np.exp(gaussian_filter(rng.normal(size=(160, 160)), 2) * 3)
    clip = Panning((3.0, -2.0))
    height, width = clip.size
    # what moves by (right 3, down -2) was at p - k (3, -2)
    corners = [(50 + 2 * k, 50 - 3 * k) for k in range(-6, 8)]
    light = np.stack([texture[y : y + height, x : x + width] for y, x in corners])
    codes = SENSOR.sample(light, EXPOSURE, key=Key(0, 0), engine="reference")
    tables = domain_tables(information_domain(SENSOR, EXPOSURE), torch.device("cpu"))
    found = restorer_motion.merges(clip, codes, tables)
    truth = SENSOR.mean(light[restorer_motion.MIDDLE], EXPOSURE)
    inner = (slice(12, -12), slice(16, -16))
    errors = {name: np.square(merged.mean_code[0].numpy() - truth)[inner].mean() for name, merged in found.items()}
    assert errors["true"] < 0.25 * errors["none"]
    assert found["true"].count[0].numpy()[inner].mean() > 8


def test_the_page_tells_which_part_of_the_gain_is_found():
    rows = {f"street_000{n}_x2": {"none": 20.0, "found": 21.5, "true": 22.0} for n in (0, 3)}
    text = restorer_motion.page({"weights": "0" * 64, "cells": {"qis-3-26": rows}})
    assert "| qis-3-26 | 20.00 | 21.50 | 22.00 | 75 % |" in text
    assert "| street_0003_x2 | gravel | hand | +1.50 of +2.00 |" in text


@pytest.mark.parametrize("data", ["nothing", "."])
def test_mistakes_are_one_line(tmp_path, data, capsys):
    assert restorer_motion.main([str(tmp_path / data), "--out", str(tmp_path / "page")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "page.md").exists()
