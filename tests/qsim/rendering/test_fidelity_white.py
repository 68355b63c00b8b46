"""The budget below white: highlights, sparks, the light left out, and what a clip states."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from small_scenes import CAMERA, plate, renderer, scene, square
from stats import critical_z

from qsim.cli.program import main
from qsim.clip.clamped_error import (
    Errors,
    error_at,
    stated,
    white_in,
)
from qsim.colour import psnr
from qsim.rendering.budget import Budget
from qsim.rendering.fidelity import choose_budget, dimming, moving
from qsim.scene import Body, Diffuse, EnvironmentImage, Glow, PointLight, RoughPlastic
from qsim.scene.shapes import ball
from qsim.streams.clip import Clip


def test_a_spark_in_the_dark_gets_a_budget():
    """Fewer than one pixel in a thousand has light: the 99.9th percentile is 0."""
    spark = scene(Body("spark", square(0.05), Glow(5.0)), light=PointLight((0, 0, -5), 1e-9))
    chosen = choose_budget(replace(spark, camera=CAMERA.resized(64, 88)), psnr=20, frames=1, denoise=False)
    assert chosen.white > 0
    frame = renderer(replace(spark, camera=CAMERA.resized(64, 88)), budget=chosen).frame(0, with_truth=False)
    assert np.percentile(frame.radiance, 99.9) == 0 < frame.radiance.mean()


def sun_in_a_ball():
    """A lacquered ball under a sky with a small sun, whose reflection is far above white."""
    sky = np.full((32, 64), 0.05)
    sky[6:8, 40:42] = 400.0
    wall = Body("wall", square(12, -1), Diffuse(0.3))
    shiny = Body("ball", ball(0.6), RoughPlastic(0.4, roughness=0.1))
    return scene(wall, shiny, light=EnvironmentImage(sky), camera=CAMERA.resized(48, 66))


def test_a_scene_with_highlights_reaches_the_requested_and_the_stated_error():
    """Errors count below white, as in scores; the 99.9th percentile of this scene is 4 dB higher.

    The reference is a converged frame, whose error is subtracted. Six frames of 3168 pixels give the error to 3 %.
    """
    made = sun_in_a_ball()
    chosen = choose_budget(made, psnr=30, frames=1, denoise=False)
    many = renderer(made, seed=5, budget=Budget(1024, chosen.bounces))
    halves = many.halves([0.0], many.budget, many.key(0))
    truth = halves.mean(axis=0)
    white = white_in(truth)
    assert np.percentile(truth, 99.9) > 1.5 * white
    frames = [renderer(made, seed=seed, budget=chosen).frame(0, with_truth=False) for seed in range(6)]
    real = [Errors.between(frame.radiance, truth, white) for frame in frames]
    own = Errors.of_halves(halves, white)
    reached = math.sqrt(np.mean([error.at_white**2 for error in real]) - own.at_white**2)
    plain = math.sqrt(np.mean([error.plain**2 for error in real]) - own.plain**2)
    stated_error = math.sqrt(np.mean([error_at(white, frame.errors_at) ** 2 for frame in frames]))
    assert plain > 1.1 * reached
    assert stated_error == pytest.approx(reached, rel=0.1)
    assert math.sqrt(np.mean([frame.error**2 for frame in frames])) == pytest.approx(plain, rel=0.25)
    assert 29.5 < psnr(white, reached) < 36  # samples come in steps


def test_the_light_left_out_is_stated_with_its_error():
    rng = np.random.default_rng(2)
    full = 1 + rng.random((3, 40, 50))
    missing = 0.02 * rng.random(full.shape)
    low, error = dimming(full, full - missing)
    assert low == pytest.approx(missing.mean() / full.mean())
    assert abs(low - 0.01 / full.mean()) < critical_z() * error


def test_the_fraction_that_moves_is_stated():
    extent = np.zeros((2, 10, 10))
    extent[:, 0, :4] = 2.0
    extent[:, 1, 0] = 0.09
    found = moving(extent, 0.0)
    assert found.chosen == "4 % of the pixels move"
    assert "those by 2 on average" in found.size
    assert moving(extent, 0.5).chosen == "5 % of the pixels move"  # 0.09 px in half a frame
    assert moving(0 * extent, 0.0).chosen == "0 % of the pixels move"


def test_a_rendered_clip_states_its_error_below_its_own_white(tmp_path, capsys):
    """`--explain` prints the limit, the motion and the light left out."""
    command = ["render", "fan", "-o", str(tmp_path / "fan"), "--frames", "2", "--height", "24", "--width", "32"]
    assert main([*command, "--psnr", "20", "--explain"]) == 0
    clip = Clip.open(tmp_path / "fan")
    text = capsys.readouterr().out
    radiance = np.stack([clip.radiance(t) for t in range(2)]).astype(np.float64)
    assert clip.info.white == pytest.approx(white_in(radiance), rel=1e-3)
    assert clip.info.render.white == pytest.approx(clip.info.white, rel=0.5)
    assert clip.info.psnr_of_truth >= clip.info.psnr_unclamped
    for words in (
        "20 dB below white",
        "of the pixels are brighter",
        "clamped there, as in scores",
        "without a clamp",
        "% of the pixels move",
        "mean light",
        "the bounces left out",
        stated(clip.info).line,
    ):
        assert words in text, words


def test_plates_that_stand_still_do_not_move():
    chosen = renderer(plate(None))
    assert chosen.motion_extent(0)[0].max() == 0
