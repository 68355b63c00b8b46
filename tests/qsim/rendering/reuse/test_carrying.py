"""Samples carried between frames: where they land, that halves stay independent, and that order does not matter."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from small_scenes import CAMERA, CHEAP, RATE, plate, renderer, scene, square
from stats import assert_mean, critical_z

from qsim.clip.clamped_error import error_at
from qsim.optics import Lens
from qsim.rendering.budget import Budget
from qsim.rendering.clip_rendering import render_clip
from qsim.scene import Body, Constant, Diffuse, Flag, Mains, Ripple, Spin, Still, SunSky, Translation
from qsim.scenes.colours import coloured

SHARED = Budget(8, 2, neighbours=5)
SLIDE = Translation((3.0, 1.0, 0.0))  # m/s before a camera of 40 px and 4 m: 0.016 px a frame, 0.5 px in 1/64 s


def pictures(made, t, budget=SHARED, frames=None, **options):
    return renderer(made, **options).carrier(budget, frames).pictures(t)


def converged(made, t, **options):
    """Return the frame from 1024 samples of other seeds."""
    one = renderer(made, seed=77, budget=Budget(1024, 2), **options)
    return one.halves([one.time(t)], one.budget, one.key(t)).mean(axis=0)


def test_the_first_picture_is_that_of_the_frame_alone():
    made = plate(SLIDE, light=SunSky())
    alone = renderer(made)
    np.testing.assert_array_equal(pictures(made, 2)[0], alone.halves([alone.time(2)], CHEAP, alone.key(2)))


def test_at_rest_more_frames_have_less_noise_and_no_bias():
    """11 frames have 11 times the samples: 1/11 of the squared error, or less, because 8 samples are a coarse grid.

    24 x 33 pixels: the ratio of two mean squares has a sigma of about 2 sqrt(2 / 792) = 10 %.
    """
    made = plate(None, light=SunSky())
    truth = converged(made, 3)
    found = pictures(made, 3)
    squares = np.mean((found.mean(axis=1) - truth) ** 2, axis=(1, 2))
    assert np.all(np.diff(squares) < 0)
    assert squares[-1] < squares[0] / 11 * (1 + critical_z() * 0.1)
    error = found[-1].mean(axis=0) - truth
    assert_mean(error, 0.0, float(error.var()))


@pytest.mark.parametrize("rate", [200.0, 64.0])
@pytest.mark.parametrize("motion", [SLIDE, Spin((0, 0, 1), 20.0), Spin((0.3, 1, 0), 5.0)])
def test_samples_land_where_their_surface_is(motion, rate):
    """In even light the surfaces keep their radiance; a plate moves by up to 0.5 px a frame, 2.5 px between the ends.

    The bias, measured by independent halves, is below a tenth of the squared noise of eight samples; left in place, the
    same samples have a bias above that noise.
    """
    made = plate(motion)
    own, *_, most = pictures(made, 6, frame_rate=rate)
    noise = np.mean((own[0] - own[1]) ** 2) / 4
    first, second = most - own
    sigma = float(np.std(first * second)) / math.sqrt(own[0].size)
    assert np.mean(first * second) < 0.1 * noise + critical_z() * sigma
    if motion is SLIDE and rate == 64.0:
        one = renderer(made, frame_rate=rate)
        left = np.mean([one.halves([one.time(t)], CHEAP, one.key(t)) for t in range(1, 12)], axis=0)
        assert np.mean(np.prod(left - own, axis=0)) > noise


def test_halves_stay_independent():
    """The errors of F_A and of B, and of F_A and F_B, are uncorrelated: sigma of a correlation is 1 / sqrt(pixels)."""
    made = plate(SLIDE, light=SunSky(), camera=CAMERA.resized(48, 66))
    found = pictures(made, 4, frame_rate=200.0)
    error = found - converged(made, 4, frame_rate=200.0)
    limit = critical_z(checks=2) / math.sqrt(48 * 66)
    for first, second in ((error[-1, 0], error[0, 1]), (found[2, 0] - found[2].mean(axis=0), error[0].sum(axis=0))):
        assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < limit


def test_a_frame_does_not_depend_on_the_frames_rendered_before():
    made = plate(Spin((0, 0, 1), 40.0), light=SunSky())
    one, other = (renderer(made, budget=SHARED, frames=9) for _ in range(2))
    for t in (0, 7, 3, 4):
        one.frame(t, with_truth=False)
    np.testing.assert_array_equal(one.frame(5).radiance, other.frame(5).radiance)


def test_frames_beyond_the_clip_are_not_used():
    made = plate(None, light=SunSky())
    first = pictures(made, 0, frames=2)
    more = pictures(made, 0, frames=3)
    np.testing.assert_array_equal(first[1], more[1])
    np.testing.assert_array_equal(first[1], first[-1])
    assert not np.array_equal(more[1], more[2])


@pytest.mark.parametrize("t", [-1, 4])
def test_a_frame_outside_the_clip_is_refused(t):
    with pytest.raises(ValueError, match=f"frame {t}: the frames that share samples are 0 to 3"):
        renderer(plate(None), budget=SHARED, frames=4).frame(t)


@pytest.mark.parametrize("neighbours", [4, 7])
def test_any_number_of_neighbours_acts(neighbours):
    """The last picture has the samples of all of them, also between and beyond the numbers that are tried."""
    made = plate(None, light=SunSky())
    found = pictures(made, 8, Budget(8, 2, neighbours=neighbours))
    fewer = pictures(made, 8, Budget(8, 2, neighbours=5 if neighbours > 5 else 3))
    assert len(found) == len(fewer) + 1
    np.testing.assert_array_equal(found[:-1], fewer)
    assert not np.array_equal(found[-1], fewer[-1])


def test_samples_that_fall_into_few_pixels_are_all_counted():
    """A plate fills the picture, and a frame later it is 2.6 px wide: 120 000 samples of each half fall into a pixel.

    In even light it has the same radiance near and far.
    """
    away = Translation((0.0, 0.0, -24.5 * RATE))
    made = scene(Body("plate", square(1.6, 3.5), Diffuse(0.3), away))
    own, most = pictures(made, 1, Budget(2048, 2, neighbours=1)).mean(axis=1)
    covered = np.s_[11:13, 16]
    assert own[covered].max() < own[0, 0] / 2, "the plate is darker than the sky"
    np.testing.assert_allclose(most[covered], own[covered], rtol=0.05)


@pytest.mark.parametrize("bad", [math.inf, math.nan])
def test_a_sample_without_a_value_spoils_its_own_pixel_only(bad):
    one = renderer(plate(Spin((0, 0, 1), 40.0), light=SunSky()), budget=SHARED, frames=4)
    carrier = one.carrier(SHARED, 4)
    before = carrier.pictures(2)
    part = carrier._kept[2].parts[0]
    values = np.array(part.radiance)
    values[100] = bad
    carrier._kept[2].parts[0] = replace(part, radiance=one.mi.Float(values))
    found = carrier.pictures(2)
    assert np.count_nonzero(~np.isfinite(found[0])) == 1
    assert np.isfinite(found[1:]).all()
    changed = np.abs(found[-1] - before[-1]) > 1e-4 * before[0].mean()
    assert np.count_nonzero(changed) <= 1


def test_an_interrupted_clip_that_shares_samples_resumes_with_the_same_bytes(tmp_path):
    made = plate(Spin((0, 0, 1), 200.0), light=SunSky())

    def stop(done, frames):
        if done == 2:
            raise KeyboardInterrupt

    budget = Budget(8, 2, neighbours=2)
    whole = render_clip(made, tmp_path / "whole", frames=4, budget=budget)
    with pytest.raises(KeyboardInterrupt):
        render_clip(made, tmp_path / "broken", frames=4, budget=budget, progress=stop)
    resumed = render_clip(made, tmp_path / "broken", frames=4, budget=budget)
    assert resumed.info.checksums == whole.info.checksums
    assert resumed.info.error_per_frame == whole.info.error_per_frame
    assert whole.info.render.neighbours == 2
    stated = whole.info.error_at_white_per_frame
    for t in (0, 3):
        frame = renderer(made, budget=budget, frames=4).frame(t)
        rounded = np.sqrt(np.mean((frame.radiance - whole.radiance(t)) ** 2))
        assert stated[t] == pytest.approx(np.hypot(error_at(whole.info.white, frame.errors_at), rounded), rel=1e-3)


def test_an_edge_keeps_its_mixture_where_a_neighbour_hides_one_side():
    """A dark square slides over a bright wall by 0.5 px a frame: what it uncovers was hidden before.

    The wall has samples in fewer frames than the square, and counts no less in the pixels of the edge.
    """
    bodies = Body("wall", square(12, -1), Diffuse(0.8)), Body("dark", square(1.6), Diffuse(0.05), SLIDE)
    made = scene(*bodies)
    truth = converged(made, 6, frame_rate=64.0)
    found = pictures(made, 6, frame_rate=64.0)
    own, most = (float(np.mean((picture.mean(axis=0) - truth) ** 2)) for picture in (found[0], found[-1]))
    assert most < own / 2


@pytest.mark.parametrize("seed", range(4))
def test_a_crop_is_cut_from_the_complete_frame(seed):
    """Radiance, truth and fireflies agree to the bit for random windows, with a choice by tiles of the whole frame."""
    rng = np.random.default_rng([41, seed])
    made = plate(Spin((0, 0, 1), 40.0), light=SunSky())
    y, x = rng.integers(0, 16, 2).tolist()
    height, width = (int(rng.integers(1, side + 1)) for side in (24 - y, 33 - x))
    whole, part = (renderer(made, budget=SHARED, crop=crop).frame(5) for crop in (None, (y, x, height, width)))
    window = np.s_[y : y + height, x : x + width]
    np.testing.assert_array_equal(part.radiance, whole.radiance[window])
    np.testing.assert_array_equal(part.depth, whole.depth[window])
    assert part.fireflies <= whole.fireflies


def test_a_body_that_deforms_keeps_its_own_samples():
    """A plate whose samples cannot be carried has its own; the wall at rest behind it has those of all frames."""
    sheet = square(1.6)
    rest = sheet.vertices + np.array([0.8, 0.0, 0.0])
    waving = Flag(rest, (Ripple(0.02, 1.0, 40.0),), Still((-0.8, 0.0, 0.0)))
    flag = Body("flag", replace(sheet, vertices=rest), Diffuse(0.6), waving)
    made = scene(Body("wall", square(12, -1), Diffuse(0.3)), flag, light=SunSky())
    own, *_, most = pictures(made, 6)
    middle = np.s_[:, 11:13, 15:18]
    np.testing.assert_allclose(most[middle], own[middle], rtol=1e-5)
    noise = [float(np.mean((found[0, :4] - found[1, :4]) ** 2)) for found in (own, most)]
    assert noise[1] < noise[0] / 4


THIN = replace(CAMERA, aperture_blur=True, focus_distance=4.0)


@pytest.mark.parametrize(
    ("made", "options", "what"),
    [
        (plate(Still()), {"shutter": 0.5}, "an open shutter"),
        (plate(Still(), camera=THIN), {}, "a thin lens"),
        (plate(Still(), camera=replace(CAMERA, lens=Lens(k1=0.01))), {}, "a lens that distorts"),
        (plate(Still(), light=Constant(0.7, flicker=Mains(100))), {}, "lights that flicker"),
        (coloured(plate(Still())), {}, "three bands"),
    ],
)
def test_frames_that_cannot_share_are_refused(made, options, what):
    with pytest.raises(ValueError, match=f"frames with {what} cannot share samples; set it to 0"):
        renderer(made, budget=SHARED, **options)


def test_neighbours_are_a_number():
    with pytest.raises(ValueError, match="neighbours: at least 0"):
        Budget(8, 2, neighbours=-1)
