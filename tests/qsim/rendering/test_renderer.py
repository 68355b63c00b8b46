"""Rendering: energy, exposure, repeatability and the hard cases.

Every scene is small. Radiometric tolerances are the renderer's measured Monte-Carlo errors times the critical z of
tests/support/stats.py. Deterministic light (one sample decides) is compared to float32 rounding.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from small_scenes import CAMERA, CHEAP, RATE, mirrored_sun, plate, renderer, scene, square
from stats import assert_same_rms, critical_z

from qsim.backend import choose
from qsim.clip.clamped_error import error_at
from qsim.optics.camera import Camera
from qsim.rendering.budget import Budget, blur_error
from qsim.rendering.denoiser import available
from qsim.rendering.engine import select
from qsim.rendering.fidelity import choose_budget
from qsim.rendering.renderer import Renderer
from qsim.scene import (
    AreaLamp,
    Body,
    Constant,
    Diffuse,
    Glow,
    Oscillation,
    PointLight,
    PulseWidth,
    Scene,
    Spin,
    Still,
    SunSky,
    Translation,
    shapes,
)


@pytest.fixture(scope="module")
def spinning() -> Renderer:
    """A spinning plate, loaded once."""
    return renderer(plate(Spin((0, 0, 1), 200.0)))


# Radiometry


def test_in_a_furnace_every_pixel_has_the_radiance_of_the_surroundings():
    """White walls in even light: direct light plus all bounces is the sky's radiance; 64 bounces leave out < 1e-3."""
    white = Diffuse(1.0)
    bodies = (Body("back", square(3, -1), white), Body("turned", square(1.5), white, Still(turn=(0.9, 0.3, 0))))
    frame = renderer(scene(*bodies), budget=Budget(256, 64)).frame(0)
    pixels = frame.radiance.size
    assert abs(frame.radiance.mean() - 0.7) < critical_z() * frame.error / math.sqrt(pixels) + 1e-3 * 0.7
    assert frame.body_id.max() == 1


def test_an_empty_furnace_is_exact():
    frame = renderer(scene()).frame(0)
    np.testing.assert_allclose(frame.radiance, 0.7, rtol=1e-6)
    assert frame.error < 1e-6
    assert (frame.body_id == -1).all()
    assert np.isinf(frame.depth).all()


def test_a_wall_under_100_lux_gives_the_photons_worked_by_hand():
    """100 lx on a 50 % Lambertian wall, f/2, T 0.9, 1.1 um, 0.5 ms at 555 nm: 6.960548 photons.

    A uniform sky of radiance E / pi gives a plane facing it the irradiance E.
    """
    from qsim.optics.radiometry import LUMINOUS_EFFICACY, expected_photons

    camera = Camera(8e-3, 2.0, 1.1e-6, 5, 7, transmission=0.9, wavelength=555e-9, origin=(0, 0, 4))
    sky = Constant(100.0 / LUMINOUS_EFFICACY / math.pi)
    made = scene(Body("wall", square(40), Diffuse(0.5)), light=sky, camera=camera)
    frame = renderer(made, budget=Budget(512, 1)).frame(0)
    photons = expected_photons(frame.radiance, camera, 5e-4)
    error = expected_photons(np.full((1, 1), frame.error), camera, 5e-4).item() / math.sqrt(photons.size)
    assert abs(photons.mean() - 6.960548) < critical_z() * error + 1e-4
    assert error < 0.02


@pytest.mark.parametrize(
    "light",
    [
        Constant(0.7),
        Constant(1.7),
        AreaLamp((1.0, 2.0, 4.0), (0.0, 0.0, 0.0), 1.0, 1.0, 5.0),
        PointLight((1, 2, 4), 9.0),
    ],
    ids=["sky", "bright sky", "lamp", "point"],
)
def test_scalar_and_vector_engines_agree(light):
    """Also for a radiance above 1, for which Mitsuba's RGB variant uses an equal-energy spectrum."""
    camera = Camera(2e-3, 2.8, 2e-4, 5, 7, origin=(0.5, 0.2, 4))
    body = Body("plate", square(1.5), Diffuse(0.6), Translation((100.0, 0, 0)))
    made = scene(body, camera=camera, light=light)
    fast = renderer(made, budget=Budget(512, 2))
    slow = renderer(made, budget=Budget(512, 2), engine=choose("scalar"))
    try:
        ours = fast.frame(1)
        theirs = slow.frame(1)
    finally:
        select()
    limit = critical_z(checks=35) * math.hypot(ours.error, theirs.error) * 2
    assert np.abs(ours.radiance - theirs.radiance).max() < limit + 1e-5
    for name in ("flow", "depth"):
        np.testing.assert_allclose(ours.truth[name], theirs.truth[name], atol=1e-4)
    assert (ours.body_id == theirs.body_id).all()


def test_the_scalar_engine_is_as_quiet_as_the_others(capfd):
    """Mitsuba's scalar variant warns of normals of smooth meshes that it cannot compute; ours replace them."""
    ball = Body("ball", shapes.ball(0.5), Diffuse(0.6), Translation((100.0, 0, 0)))
    try:
        slow = renderer(scene(ball), budget=CHEAP, engine=choose("scalar"))
        slow.frame(0)
        slow.frame(1)
    finally:
        select()
    assert capfd.readouterr() == ("", "")


# Exposure


def test_an_open_shutter_blurs_by_the_motion_and_keeps_the_energy():
    """A glowing plate in the dark: blur redistributes light but keeps its sum; the sharp instant has no ramp."""
    lamp = Body("lamp", square(0.8), Glow(2.0), Translation((3 * RATE * 4 / CAMERA.focal_pixels, 0, 0)))
    made = Scene("lamp", 0, CAMERA, (), (lamp,))
    frame = renderer(made, shutter=1.0, budget=Budget(18 * 8, 1, 9)).frame(0)
    assert frame.radiance.sum() == pytest.approx(frame.sharp.sum(), rel=0.02)
    row = frame.radiance[12] / 2.0
    sharp = frame.sharp[12] / 2.0
    assert np.count_nonzero((row > 0.05) & (row < 0.95)) >= 6
    assert np.count_nonzero((sharp > 0.05) & (sharp < 0.95)) <= 2


def test_the_mean_of_more_instants_converges_like_the_stated_blur_error():
    extent = 3.0
    lamp = Body("lamp", square(0.8), Glow(1.0), Translation((extent * RATE * 4 / CAMERA.focal_pixels, 0, 0)))
    made = Scene("lamp", 0, CAMERA, (), (lamp,))
    rows = {k: renderer(made, shutter=1.0, budget=Budget(200 * k, 1, k, False)).frame(0) for k in (5, 9, 63)}
    for k in (5, 9):
        worst = np.abs(rows[k].radiance - rows[63].radiance)[8:16].max()
        assert worst < blur_error(extent, k) + 8 * rows[k].error  # the noise of edge pixels is above the mean
    assert rows[5].radiance.shape == (24, 33)


# Repeatability


def test_any_frame_alone_is_the_same_frame_and_seeds_differ(spinning):
    made = plate(Spin((0, 0, 1), 200.0))
    in_order = [spinning.frame(t) for t in range(3)]
    alone = renderer(made).frame(2)
    assert alone.radiance.tobytes() == in_order[2].radiance.tobytes()
    assert all((alone.truth[name] == in_order[2].truth[name]).all() for name in alone.truth)
    assert (renderer(made, seed=1).frame(2).radiance != alone.radiance).any()


def test_the_measured_error_is_the_error():
    """(A - B) / 2 within six renders of one instant against the differences between three pairs of them."""
    views = [renderer(plate(None, light=SunSky()), seed=seed) for seed in range(6)]
    halves = np.stack([view.halves([0.0], view.budget, view.key(0)) for view in views])  # [6, 2, H, W]
    frames = [view.frame(0, with_truth=False) for view in views]
    within = (halves[:, 0] - halves[:, 1]) / 2
    np.testing.assert_allclose([frame.error for frame in frames], np.sqrt(np.mean(within**2, axis=(1, 2))), rtol=1e-6)
    images = np.stack([frame.radiance for frame in frames]).astype(np.float64)
    assert_same_rms(within, (images[::2] - images[1::2]) / math.sqrt(2))


def test_a_frame_in_parts_is_as_good_as_a_complete_one(monkeypatch):
    """Parts divide pixels, not samples: grids of 64 in 16 parts, not 16 grids of 4 (1.7 times the error)."""
    made = plate(None, light=SunSky(), camera=CAMERA)
    entire, parts = (renderer(made, budget=Budget(128, 2)) for _ in range(2))
    whole = entire.frame(1, with_truth=False)
    halves = entire.halves([entire.time(1)], entire.budget, entire.key(1))
    monkeypatch.setattr("qsim.rendering.camera_rays.MAX_SAMPLES_IN_FLIGHT", 128 * 50)
    assert [len(part) for part in parts.film.parts(128)] == [49, 50] * 8
    split = parts.frame(1, with_truth=False)
    assert_same_rms(np.subtract(*halves), np.subtract(*parts.halves([parts.time(1)], parts.budget, parts.key(1))))
    assert abs(split.radiance - whole.radiance).mean() < 2 * whole.error
    albedo = [one.surfaces([0.0], one.key(0))[0].mean() for one in (renderer(made), parts)]
    assert albedo[0] == pytest.approx(albedo[1], abs=0.01)


@pytest.mark.parametrize("denoise", [False, True])
def test_a_sample_that_is_not_a_number_costs_one_pixel(monkeypatch, denoise):
    if denoise and not available():
        pytest.skip("Open Image Denoise is not installed: pip install pyoidn")
    one = renderer(plate(None, light=SunSky()), budget=Budget(8, 2, denoise=denoise))
    halves = one.halves([0.0], one.budget, one.key(0))
    halves[0, 3, 4] = np.nan
    monkeypatch.setattr(one, "means", lambda *_: np.stack([halves] * 3))
    frame = one.frame(0, with_truth=False)
    assert np.isfinite(frame.radiance).all()
    assert math.isfinite(frame.error)
    assert frame.fireflies >= 1


def test_a_sharp_sample_that_is_not_a_number_is_counted(monkeypatch):
    one = renderer(plate(None), shutter=1.0, budget=Budget(8, 2, 3))

    def means(instants, *_):
        found = np.ones((3, 2, *one.shape))
        if len(instants) == 1:  # the sharp one
            found[0, 0, 3, 4] = np.nan
        return found

    monkeypatch.setattr(one, "means", means)
    frame = one.frame(0, with_truth=False)
    assert np.isfinite(frame.sharp).all()
    assert frame.fireflies == 1


def test_a_sharp_frame_with_the_larger_error_states_the_error(monkeypatch):
    """The sharp frame is the truth of scores: its halves are 1 +- 0.3, those of the exposure are equal."""
    one = renderer(plate(None), shutter=1.0, budget=Budget(8, 2, 3))

    def means(instants, *_):
        apart = 0.3 if len(instants) == 1 else 0.0
        return np.stack([np.stack([np.full(one.shape, 1 + apart), np.full(one.shape, 1 - apart)])] * 3)

    monkeypatch.setattr(one, "means", means)
    frame = one.frame(0, with_truth=False)
    assert frame.error == pytest.approx(0.3)
    assert error_at(1.0, frame.errors_at) == pytest.approx(0.3)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_pilot_and_a_flickering_exposure_tolerate_samples_that_are_not_numbers(monkeypatch, value):
    """One pixel of every pass has no value: the budget and the error of an open shutter are those of the others."""
    passed = Renderer._pass

    def broken(self, *arguments):
        found = passed(self, *arguments)
        found[..., 0, 40] = value
        return found

    monkeypatch.setattr(Renderer, "_pass", broken)
    flight = Translation((600.0, 0.0, 0.0))
    light = Constant(0.7, PulseWidth(3000, 0.2))
    frame = renderer(plate(flight, light), Budget(72, 2, 9), shutter=1.0).frame(0, with_truth=False)
    assert math.isfinite(frame.error)
    assert frame.error < frame.radiance.mean()
    assert np.isfinite(frame.errors_at).all()
    chosen = choose_budget(plate(None), psnr=25, frames=2, denoise=False)
    errors = (chosen.left_out, chosen.left_out_at_white, chosen.dimmed, chosen.dimmed_error)
    assert np.isfinite(errors).all()
    assert 0 < chosen.white < math.inf


def test_a_crop_shows_its_window_of_the_frame(spinning):
    made = spinning.scene
    whole = spinning.frame(1)
    part = renderer(made, crop=(3, 5, 9, 14)).frame(1)
    assert part.radiance.shape == (9, 14)
    for name in ("flow", "valid", "depth", "body_id"):
        window = whole.truth[name][..., 3:12, 5:19]
        np.testing.assert_allclose(part.truth[name], window, atol=1e-5)
    assert np.sqrt(np.mean((part.radiance - whole.radiance[3:12, 5:19]) ** 2)) < 3 * math.hypot(part.error, whole.error)
    with pytest.raises(ValueError, match="is not inside 24 x 33 pixels"):
        renderer(made, crop=(0, 20, 9, 14))


# Hard cases


@pytest.mark.parametrize(("height", "width"), [(1, 1), (7, 5), (1, 9)])
def test_odd_sizes(height, width):
    frame = renderer(plate(Spin((0, 0, 1), 200.0), camera=CAMERA.resized(height, width))).frame(0)
    assert frame.radiance.shape == frame.valid.shape == (height, width)
    assert np.isfinite(frame.radiance).all()


@pytest.mark.parametrize(
    "motion",
    [
        Translation((0.0, 0.0, 9.0 * RATE / 2)),  # crosses the camera's plane between the frames
        Translation((0.0, 0.0, 3.9 * RATE)),  # fills the view next
        Translation((10.0 * RATE, 0.0, 0.0)),  # 100 px per frame, out of the view
        Oscillation((0.0, 1.0, 0.0), 200.0),
    ],
)
def test_wild_motions_render(motion):
    views = renderer(plate(motion))
    for t in (0, 1, 2):
        frame = views.frame(t)
        for value in (frame.radiance, frame.flow, frame.flow_back):
            assert np.isfinite(value).all()


def test_a_mirror_that_faces_the_sun_reports_its_fireflies():
    frame = renderer(mirrored_sun(), budget=Budget(8, 4)).frame(0)
    assert np.isfinite(frame.radiance).all()
    assert frame.fireflies > 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"frame_rate": 0.0}, "frame_rate: a positive number"),
        ({"shutter": 1.5}, "shutter: a share of the frame time"),
    ],
)
def test_rates_out_of_range_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        renderer(scene(), **options)


@pytest.mark.slow
def test_memory_stays_constant_over_a_thousand_frames():
    """Resident size after 200 frames (kernels compiled, pools filled) and after 1000: at most 30 MB more."""
    import os
    from pathlib import Path

    status = Path("/proc/self/statm")
    if not status.exists():
        pytest.skip("needs /proc")

    def resident() -> float:
        return int(status.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

    views = renderer(plate(Spin((0, 0, 1), 200.0)))
    sizes = []
    for t in range(1000):
        views.frame(t)
        if t in (199, 999):
            sizes.append(resident())
    assert sizes[1] - sizes[0] < 30
