"""White and errors clamped there: against what they are, over random pictures; what clips say of them."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from clips import write_clip, write_dataset
from small_scenes import CAMERA, plate, renderer, scene, square
from stats import critical_z

from qsim.cli.program import main
from qsim.clip.clamped_error import (
    STEPS,
    Errors,
    clamped_squares,
    decibels,
    error_at,
    frame_errors,
    measured,
    stated,
    white_in,
    white_of,
)
from qsim.clip.clip import Clip
from qsim.dataset.dataset import Dataset
from qsim.dataset.job import Job
from qsim.optics.radiometry import WHITE_PER_MEAN
from qsim.rendering import denoiser
from qsim.rendering.budget import Budget
from qsim.rendering.fidelity import choose_budget, dimming, moving
from qsim.report import report
from qsim.scene import Body, Diffuse, EnvironmentImage, Glow, PointLight, RoughPlastic
from qsim.scene.shapes import ball

SIZE = 200  # px, sides of the pictures of noise


def truth_of(rng: np.random.Generator) -> np.ndarray:
    """A picture whose brightest pixels lie 1 to 100 times above white."""
    return np.exp(rng.uniform(0.2, 2.0) * rng.standard_normal((SIZE, SIZE)))


@pytest.mark.parametrize("seed", range(40))
def test_halves_tell_the_error_at_white(seed):
    """Noise in proportion to the light or even, weak or strong, and rare bright stray paths: any picture, any white.

    The squares are drawn once for the estimate and once for the real error. What noise carries over white and back
    counts once more than it should: at most a third too much, never too little beyond what the draws explain.
    """
    rng = np.random.default_rng([7, seed])
    truth = truth_of(rng)
    white = white_in(truth) * rng.uniform(0.3, 2.0)
    level = 10 ** rng.uniform(-3, -0.7)
    sigma = level * (truth if seed % 2 else truth.mean())
    halves = truth + math.sqrt(2) * sigma * rng.standard_normal((2, SIZE, SIZE))
    if seed % 4 >= 2:  # in one of 200 pixels of a half a path of up to 30 whites, whose mean belongs to the truth
        stray = 30 * white * rng.random()
        halves += stray * (rng.random(halves.shape) < 0.005)
        truth = truth + 0.005 * stray
    halves = np.maximum(halves, 0)
    picture = halves.mean(axis=0)
    real = (np.minimum(picture, white) - np.minimum(truth, white)) ** 2
    found = clamped_squares((halves[0] - halves[1]) ** 2 / 4, picture, halves.min(axis=0), white)
    assert Errors.of_halves(halves, white).at_white == pytest.approx(math.sqrt(found.mean()))
    chance = critical_z(checks=40) * math.hypot(real.std(), found.std()) / SIZE
    assert 0.85 * real.mean() - chance < found.mean() < 1.35 * real.mean() + chance


def test_without_anything_above_white_the_clamp_changes_nothing():
    halves = 1 + 0.01 * np.random.default_rng(1).standard_normal((2, 50, 50))
    errors = Errors.of_halves(halves, 2.0)
    assert errors.at_white == errors.plain == pytest.approx(0.01 / math.sqrt(2), rel=0.1)


def test_white_is_the_lower_of_two():
    assert white_of(1.0, 10.0) == WHITE_PER_MEAN
    assert white_of(1.0, 1.2) == 1.2
    assert white_of(1.0, 0.0) == WHITE_PER_MEAN  # a spark in the dark


def test_a_spark_in_the_dark_gets_a_budget():
    """Fewer than one pixel in a thousand has light: the 99.9th percentile is 0."""
    spark = scene(Body("spark", square(0.05), Glow(5.0)), light=PointLight((0, 0, -5), 1e-9))
    chosen = choose_budget(replace(spark, camera=CAMERA.resized(64, 88)), psnr=20, frames=1, denoise=False)
    assert chosen.white > 0
    frame = renderer(replace(spark, camera=CAMERA.resized(64, 88)), budget=chosen).frame(0, with_truth=False)
    assert np.percentile(frame.radiance, 99.9) == 0 < frame.radiance.mean()


@pytest.mark.parametrize("seed", range(20))
def test_an_error_is_read_off_at_any_white(seed):
    """Between the whites at which a frame states it, to 3 %; the true one is smooth."""
    rng = np.random.default_rng([8, seed])
    truth = truth_of(rng)
    halves = truth + 0.05 * rng.standard_normal((2, SIZE, SIZE)) * truth
    foreseen = white_in(truth)
    pairs = frame_errors(lambda white: Errors.of_halves(halves, white).at_white, foreseen)
    white = foreseen * rng.uniform(STEPS[0], STEPS[-1])
    assert error_at(white, pairs) == pytest.approx(Errors.of_halves(halves, white).at_white, rel=0.03)
    assert error_at(foreseen, pairs) == pytest.approx(Errors.of_halves(halves, foreseen).at_white)


def test_a_clip_states_both_figures_below_its_own_white():
    pairs = [[[1.0, 0.01], [4.0, 0.04]], [[1.0, 0.02], [4.0, 0.04]]]
    found = measured(mean=0.4, high=5.0, errors=[0.1, 0.1], errors_at=pairs)
    assert found["white"] == pytest.approx(1.0)
    assert found["error_at_white_per_frame"] == [0.01, 0.02]
    assert found["psnr_of_truth"] == pytest.approx(-10 * math.log10((0.01**2 + 0.02**2) / 2))
    assert found["psnr_unclamped"] == pytest.approx(20.0)
    line = stated(found | {"mean_radiance": 0.4}).line
    assert line == "36.0 dB below white (2.5 x the mean), clamped there; 20.0 dB unclamped"
    plain = measured(0.4, 5.0, [0.1, 0.1], [[], []])  # a writer that knows no clamp: the plain error is no less
    assert plain["psnr_of_truth"] == plain["psnr_unclamped"]
    assert "psnr_of_truth" not in measured(0.0, 0.0, [0.1], [[]])


def test_a_clip_of_an_earlier_version_is_named_in_its_own_unit(tmp_path):
    clip = write_clip(tmp_path / "old", frames=3, height=12, width=16)
    meta = json.loads((clip.path / "clip.json").read_text())
    for key in ("white", "error_at_white_per_frame", "psnr_unclamped", "checksum"):
        meta.pop(key)
    (clip.path / "clip.json").write_text(json.dumps(meta | {"psnr_of_truth": 38.25}))
    found = stated(Clip.open(clip.path).meta)
    assert found.line == "38.2 dB below the 99.9th percentile (a clip of an earlier version)"
    assert found.line in report.build_page(clip.path)
    assert stated({"mean_radiance": 1.0}) is None


def sun_in_a_ball():
    """A lacquered ball under a sky with a small sun, whose mirror picture is far above white."""
    sky = np.full((32, 64), 0.05)
    sky[6:8, 40:42] = 400.0
    wall = Body("wall", square(12, -1), Diffuse(0.3))
    shiny = Body("ball", ball(0.6), RoughPlastic(0.4, roughness=0.1))
    return scene(wall, shiny, light=EnvironmentImage(sky), camera=CAMERA.resized(48, 66))


def test_a_scene_with_highlights_reaches_what_was_asked_and_stated():
    """Below white, where scores count it: the 99.9th percentile of this scene lies 4 dB above.

    Against a converged frame, whose own error is taken off. Six frames of 3168 pixels know their error to about 3 %.
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
    said = math.sqrt(np.mean([error_at(white, frame.errors_at) ** 2 for frame in frames]))
    assert plain > 1.1 * reached
    assert said == pytest.approx(reached, rel=0.1)
    assert math.sqrt(np.mean([frame.error**2 for frame in frames])) == pytest.approx(plain, rel=0.25)
    assert 29.5 < decibels(white, reached) < 36  # samples come in steps


def test_a_data_set_of_the_earlier_unit_is_not_mixed_with_the_new_one(tmp_path, monkeypatch):
    with monkeypatch.context() as earlier:
        earlier.setattr(Job, "digest", property(Job.digest_with))
        folder = write_dataset(tmp_path / "set", {"train": 2})
    (folder / "jobs" / "train_0.json").unlink()
    with pytest.raises(ValueError, match=r"below the 99\.9th percentile; now it is dB below white"):
        write_dataset(folder, {"train": 2})
    assert len(Dataset.open(folder).clips()) >= 1  # and stays readable
    (folder / "dataset.json").unlink()  # it was killed before its end: only the records say whose it is
    with pytest.raises(ValueError, match="was begun by an earlier version, whose psnr meant"):
        write_dataset(folder, {"train": 2})


@pytest.mark.parametrize("seed", range(10))
def test_a_denoised_frame_keeps_the_mean_light(monkeypatch, seed):
    """Whatever share of the light a denoiser loses or adds, up to a few per cent."""
    rng = np.random.default_rng([9, seed])
    shift = rng.uniform(0.97, 1.03)
    monkeypatch.setattr(denoiser, "denoised", lambda half, *_: shift * np.ones_like(half))
    halves = 1 + 0.3 * rng.standard_normal((2, 128, 128))
    mixed = denoiser.cleaned_mean(halves, halves[0], halves[0], 2.5)
    moved = abs(shift - 1) > denoiser.KEPT * mixed.error
    if not moved:
        assert mixed.picture.mean() == pytest.approx(halves.mean(), rel=1e-12)
    assert abs(mixed.picture.mean() - halves.mean()) <= abs(shift * 1 - halves.mean())


def test_a_stray_path_does_not_brighten_a_whole_frame(monkeypatch):
    """One pixel of a million times the light is 60 times the mean of the frame: it moves it by a part of its error."""
    monkeypatch.setattr(denoiser, "denoised", lambda half, *_: np.ones_like(half))
    halves = 1 + 0.01 * np.random.default_rng(1).standard_normal((2, 128, 128))
    halves[0, 5, 5] = 1e6
    mixed = denoiser.cleaned_mean(halves, halves[0], halves[0], 2.5)
    assert np.median(mixed.picture) == pytest.approx(1.0, abs=0.02)


def test_the_light_left_out_is_told_with_its_error():
    rng = np.random.default_rng(2)
    full = 1 + rng.random((3, 40, 50))
    missing = 0.02 * rng.random(full.shape)
    low, error = dimming(full, full - missing)
    assert low == pytest.approx(missing.mean() / full.mean())
    assert abs(low - 0.01 / full.mean()) < critical_z() * error


def test_the_share_that_moves_is_said():
    travel = np.zeros((2, 10, 10))
    travel[:, 0, :4], travel[:, 1, 0] = 2.0, 0.09
    found = moving(travel, 0.0)
    assert found.chosen == "4 % of the pixels move"
    assert "those by 2 on average" in found.size
    assert moving(travel, 0.5).chosen == "5 % of the pixels move"  # 0.09 px in half a frame
    assert moving(0 * travel, 0.0).chosen == "0 % of the pixels move"


def test_a_rendered_clip_states_its_error_below_its_own_white(tmp_path, capsys):
    """And `--explain` says what that means."""
    command = ["render", "fan", "-o", str(tmp_path / "fan"), "--frames", "2", "--height", "24", "--width", "32"]
    assert main([*command, "--psnr", "20", "--explain"]) == 0
    clip, text = Clip.open(tmp_path / "fan"), capsys.readouterr().out
    radiance = np.stack([clip.radiance(t) for t in range(2)]).astype(np.float64)
    assert clip.meta["white"] == pytest.approx(white_in(radiance), rel=1e-3)
    assert clip.meta["render"]["white"] == pytest.approx(clip.meta["white"], rel=0.5)
    assert clip.meta["psnr_of_truth"] >= clip.meta["psnr_unclamped"]
    for words in ("20 dB below white", "of the pixels are brighter", "clamped there, as in scores", "without a clamp",
                  "% of the pixels move", "mean light", "the bounces left out", stated(clip.meta).line):  # fmt: skip
        assert words in text, words


def test_plates_that_stand_still_do_not_move():
    chosen = renderer(plate(None))
    assert chosen.motion_extent(0)[0].max() == 0
