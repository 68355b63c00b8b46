"""The budget: its choices hold the error asked for, its formulae are checked by brute force."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from small_scenes import CAMERA, plate, renderer, scene, square

from qsim.clip.clamped_error import Errors, Stated, decibels, error_at, white_in
from qsim.rendering import fidelity, pilot
from qsim.rendering.budget import Allowed, Budget, blur_error, blur_left, explain, grid_samples
from qsim.rendering.denoiser import available, mixture
from qsim.rendering.fidelity import Noise, choose_budget, shortfall
from qsim.rendering.renderer import Renderer
from qsim.scene import Body, Diffuse, Glow, Oscillation, PointLight, Scene, Spin, SunSky, Texture, Translation


def test_sample_counts_are_those_of_the_sampler(capfd):
    """Mitsuba warns on its console when it rounds a count that its grid cannot hold."""
    for samples in range(1, 60):
        count = grid_samples(samples)
        assert samples <= count <= (math.sqrt(samples) + 2) ** 2
        assert grid_samples(count) == count
    from qsim.rendering import engine

    engine.select()
    import mitsuba as mi

    for samples in (1, 2, 3, 5, 7, 11, 13, 17, 23, 31, 32, 60, 127):
        mi.load_dict({"type": "multijitter", "sample_count": grid_samples(samples)})
    assert "rounded" not in capfd.readouterr().out


@pytest.mark.parametrize(("travel", "instants"), [(0.5, 1), (3.0, 5), (3.0, 9), (4.2, 7), (1.0, 1)])
def test_the_blur_error_bounds_the_midpoint_rule_at_an_edge(travel, instants):
    """A pixel whose coverage grows while an edge passes it: exact integral against K instants, at any offset."""
    offsets = np.linspace(-travel, 1 + travel, 801)
    fine = (np.arange(4000) + 0.5) / 4000
    coarse = (np.arange(instants) + 0.5) / instants

    def mean(times):
        return np.clip(offsets[:, None] + travel * (times - 0.5), 0, 1).mean(axis=1)

    worst = np.abs(mean(fine) - mean(coarse)).max()
    # Two kinks of the coverage may fall into the exposure: at most twice the error of one.
    assert worst <= 2 * blur_error(travel, instants) + 1e-6
    assert worst >= 0.3 * blur_error(travel, instants)


def test_no_motion_needs_one_instant():
    assert blur_error(0.0, 1) == 0
    chosen = choose_budget(plate(None, light=SunSky()), shutter=1.0, psnr=30, denoise=False)
    assert chosen.sub_frames == 1
    assert not chosen.sharp


@pytest.mark.parametrize("psnr", [32.0, 42.0])
def test_the_error_asked_for_is_reached_without_waste(psnr):
    made = plate(Spin((0, 0, 1), 200.0), light=SunSky())
    chosen = choose_budget(made, psnr=psnr, denoise=False)
    frames = [Renderer(made, budget=chosen).frame(t, with_truth=False) for t in (1, 9)]
    white = white_in(np.stack([frame.radiance for frame in frames]))
    reached = decibels(white, math.sqrt(np.mean([error_at(white, frame.errors_at) ** 2 for frame in frames])))
    assert psnr - 1 < reached < psnr + 10  # samples come in even squares: 4, 16, 36


def test_more_light_on_the_sensor_asks_for_more_samples():
    made = plate(Spin((0, 0, 1), 200.0), light=SunSky())
    plain, bright = (choose_budget(made, psnr=25, ppp=ppp, denoise=False) for ppp in (None, 300.0))
    assert bright.samples > plain.samples
    assert "the sensor at 300 photons" in explain(bright)


def test_bounces_follow_the_scene():
    """One matt plate in the open needs one bounce or few; the inside of a bright corner needs more."""
    open_air = choose_budget(scene(Body("plate", square(1.5), Diffuse(0.5))), psnr=30, denoise=False)
    lamp = Body("lamp", square(0.4, -0.9), Glow(20.0))
    walls = [Body(f"wall{i}", square(2.2, -1.1), Diffuse(0.95), turned) for i, turned in enumerate(BOX)]
    closed = choose_budget(Scene("box", 0, CAMERA, (), (lamp, *walls)), psnr=30, denoise=False)
    assert open_air.bounces < closed.bounces
    assert "bounces" in explain(closed)


BOX = [Spin((0, 1, 0), 0.0, angle) for angle in (0.0, math.pi / 2, -math.pi / 2)] + [
    Spin((1, 0, 0), 0.0, angle) for angle in (math.pi / 2, -math.pi / 2)
]


def test_an_open_shutter_gets_an_odd_number_of_instants():
    made = plate(Spin((0, 0, 1), 400.0), light=PointLight((1, 2, 4), 30.0))
    chosen = choose_budget(made, shutter=1.0, psnr=35, denoise=False)
    assert chosen.sub_frames % 2 == 1
    assert chosen.sub_frames > 1
    assert chosen.sharp
    assert "mean of" in explain(chosen)


def test_a_shadow_that_moves_on_a_wall_at_rest_is_blurred_too():
    """Nothing that is seen moves; a slat beside the lamp throws a shadow that runs across the wall.

    With the instants chosen, the mean over the exposure is that of many more to the error asked for; that of the three
    which motion takes at least is not.
    """
    slat = Body("slat", square(0.15), Diffuse(0.5), Translation((100.0, 0.0, 0.0), (-0.5, 0.0, 2.0)))
    made = scene(Body("wall", square(6, -1), Diffuse(0.7)), slat, light=PointLight((0.0, 0.0, 3.0), 40.0))
    made = replace(made, camera=replace(CAMERA, origin=(0.0, 0.0, 1.5)))
    chosen = choose_budget(made, shutter=1.0, psnr=55, denoise=False)
    assert chosen.sub_frames > 3
    assert chosen.sharp
    assert "light and shadow" in explain(chosen)
    means = {}
    for count in (3, chosen.sub_frames, 45):
        one = renderer(made, shutter=1.0, budget=replace(chosen, samples=64 * count, sub_frames=count))
        means[count] = one.frame(10, with_truth=False).radiance
    allowed = white_in(means[45]) * 10 ** (-55 / 20)
    far = {count: math.sqrt(np.mean((image - means[45]) ** 2)) for count, image in means.items()}
    assert far[chosen.sub_frames] < allowed < far[3]


def held(made: Scene, psnr: float, t: int) -> tuple[Budget, float, float, float]:
    """What is chosen for an open shutter; rms error at white allowed, of frame t against 315 instants, and stated."""
    chosen = choose_budget(made, shutter=1.0, psnr=psnr, denoise=False)
    frame = renderer(made, shutter=1.0, budget=chosen).frame(t, with_truth=False)
    many = Budget(8 * 315, chosen.bounces, 315, sharp=False)
    truth = renderer(made, shutter=1.0, seed=1, budget=many).frame(t, with_truth=False).radiance
    white = white_in(truth)
    real = Errors.between(frame.radiance, truth, white).at_white
    return chosen, white * 10 ** (-psnr / 20), real, error_at(white, frame.errors_at)


def test_a_wheel_that_turns_once_in_the_exposure_has_not_rested():
    """Its flow is 0, and what it looks like after a third or a fifth of a turn is the same for 15 blades only."""
    rate = 2 * math.pi * 2000
    wheel = Body("wheel", square(1.2), Diffuse(0.8), Spin((0, 0, 1), rate))
    chosen, allowed, real, stated = held(scene(Body("wall", square(12, -1), Diffuse(0.1)), wheel), 30, 10)
    assert chosen.sub_frames >= 15
    assert real < allowed
    assert 0.3 < stated / real < 4  # its instants are told by thirds, of a shape with four of everything
    assert "0 % of the pixels move" not in explain(chosen)


def test_a_body_that_no_pilot_frame_shows_is_found():
    """It crosses the view in frames 4 to 7; light is looked at in frames 0, 10 and 20 of 21."""
    path = Translation((1650.0, 0.0, 0.0), (-1650.0 * 5.5 / 2000, 0.0, 0.0))
    made = scene(Body("wall", square(12, -1), Diffuse(0.2)), Body("ghost", square(0.5), Diffuse(0.9), path))
    chosen, allowed, real, stated = held(made, 30, 5)
    assert chosen.sub_frames > 3
    assert real < allowed
    assert 0.5 < stated / real < 4


def test_frames_are_added_in_which_things_go_that_rest_in_the_others():
    """A slat out of view that stands still in frames 0, 10 and 20, and runs in 5 and 15."""
    swing = Oscillation((1.0, 0.0, 0.0), 100.0, math.pi / 2, (0.0, 50.0, 0.0))
    made = scene(Body("wall", square(12, -1), Diffuse(0.2)), Body("slat", square(0.5), Diffuse(0.9), swing))
    seen = pilot.Pilot.of(made, 2000.0, 1.0, 21, 0)
    assert {0, 10, 20} < set(seen.times)
    assert {5, 15} & set(seen.times)
    assert pilot.Pilot.of(made, 2000.0, 0.0, 21, 0).times == (0, 10, 20)
    assert not pilot.rests(made)
    assert pilot.rests(plate(None))


@pytest.mark.parametrize(("count", "edges"), [(9, 0.5), (9, 6.0), (33, 0.5), (33, 20.0), (3, 0.3)])
def test_every_third_instant_tells_the_error_of_all(count, edges):
    """An edge runs over pixels at random places by so many px a step.

    Within a factor of three of the error, or, where the steps are below a pixel and those of the thirds above, of what
    `blur_error` allows for.
    """
    places = np.random.default_rng(3).uniform(-0.5, 0.5, 40000)

    def mean(times):
        return np.mean([np.clip((t - places) * edges * count + 0.5, 0, 1) for t in times], axis=0)

    times = (np.arange(count) + 0.5) / count - 0.5
    means = np.array([mean(times), mean(times[1::3]), mean(times[count // 2 : count // 2 + 1])])
    real = np.sqrt(np.mean((means[0] - mean((np.arange(4000) + 0.5) / 4000 - 0.5)) ** 2))
    assert (
        real / 3 < blur_left(np.stack([means, means], axis=1), count) < 3 * max(real, blur_error(edges * count, count))
    )


def test_instants_are_foretold_beyond_the_trials_and_their_limit_is_said():
    rest = np.zeros((1, 8, 8))
    count, left, finding = fidelity.fewest_instants(rest, 1.0, lambda k: 27 / k)
    assert 90 <= count <= 96
    assert left == pytest.approx(27 / count)
    assert "light and shadow" in finding.size
    count, left, finding = fidelity.fewest_instants(rest, 1.0, lambda k: 2700 / k)
    assert count == fidelity.MOST_INSTANTS
    assert left > 1
    assert f"the limit of {count} instants is reached" in finding.size


def test_a_lucky_small_pilot_is_not_believed():
    """A caustic that 8 samples missed: errors of 0.001, 0.09 and 0.03 with 8, 32 and 128 samples."""
    halves = [np.array([np.full((1, 4, 4), error), np.full((1, 4, 4), -error)]) + 1 for error in (0.001, 0.09, 0.03)]
    allowed = Allowed(white=100.0, target=0.0025)
    samples, finding = fidelity.fewest_samples(Noise.of(halves, 100.0), 1, allowed, 1.0)
    assert samples >= 128 * (0.03 / 0.0025) ** (1 / 0.75) * 0.99
    assert "expected" in finding.size


def test_an_error_that_hardly_falls_asks_for_more_samples_than_there_are():
    assert pilot._needed([8, 32, 128], [1.0, 0.99999], 0.1) > 1e30
    assert pilot._needed([8, 32, 128], [1.0, 1.1], 0.1) == math.inf
    assert pilot._needed([8, 32, 128], [1.0, 0.5], 0.25) == pytest.approx(128)


def test_later_bounces_are_part_of_the_stated_error():
    cheap = Budget(8, 2)
    errors = [
        renderer(plate(None), budget=b).frame(0, with_truth=False).error for b in (cheap, replace(cheap, left_out=0.3))
    ]
    assert errors[1] == pytest.approx(math.hypot(errors[0], 0.3))


def test_a_clip_that_misses_what_was_asked_is_told():
    low = Stated(38.9, 30.0, "white")
    assert shortfall(replace(low, psnr=39.6), 40) == shortfall(None, 40) == ""
    assert "38.9 dB below white, clamped there; 30.0 dB unclamped, where 40 were asked for" in shortfall(low, 40)
    assert shortfall(replace(low, unclamped=None), 40) == ""  # an earlier version's, of another unit


def test_bounces_that_no_pilot_tried_are_not_called_nothing():
    full = np.full((1, 4, 4), 2.0)
    bounces, cut, finding = fidelity.fewest_bounces(lambda depth: full - 0.1, full, Allowed(5.0, 0.03))
    assert bounces == fidelity.DEEPEST
    assert Errors.between(cut, full, 5.0).plain == pytest.approx(0.1)
    assert "deeper ones were not tried" in finding.size


def test_the_choice_is_a_function_of_the_question():
    made = plate(Spin((0, 0, 1), 200.0), light=SunSky())
    assert choose_budget(made, psnr=25) == choose_budget(made, psnr=25)


def test_a_lamp_behind_a_wall_is_said():
    made = scene(Body("wall", square(50, -1), Diffuse(0.5)), light=PointLight((0, 0, -2), 1.0))
    with pytest.raises(ValueError, match="the pilot saw no light"):
        choose_budget(made)


@pytest.mark.parametrize("psnr", [0.0, 200.0])
def test_an_error_nobody_can_ask_for_is_refused(psnr):
    with pytest.raises(ValueError, match="10 to 80 dB"):
        choose_budget(plate(None), psnr=psnr)


def test_a_budget_of_nothing_is_refused():
    with pytest.raises(ValueError, match=r"Budget.samples: at least 1, got 0"):
        Budget(samples=0)


def test_samples_are_shared_among_halves_and_instants():
    assert Budget(samples=72).grid(1) == 36
    assert Budget(samples=72).grid(9) == 4
    assert Budget(samples=1).grid(5) == 4


@pytest.mark.parametrize("bias", [0.0, 0.3, 2.0])
def test_the_best_mixture_is_known_without_the_truth(bias):
    """A filter that adds a bias to the truth, raw noise of 0.5: A - B knows nothing of the bias, D(A) - B does.

    The shares are as 1 / variance, that of the mean of two halves 0.125: w = 0.125 / (0.125 + bias^2), and
    error^2 = w bias^2. Over 40 000 pixels the estimate has a sigma of 0.001 or less (0.125 sqrt(2) / 200; with the bias
    of 2, w is 0.03 and bias Z w as large), of which one is added.
    """
    rng = np.random.default_rng(3)
    truth = rng.random((200, 200))
    halves = truth + 0.5 * rng.standard_normal((2, 200, 200))
    mixed = mixture(halves, np.stack([truth + bias] * 2))
    share, error = mixed.share, mixed.error
    best = 0.125 / (0.125 + bias**2)
    assert share.mean() == pytest.approx(best, abs=0.05)
    assert error**2 == pytest.approx(max(best * bias**2, 0.00125), abs=0.006)


def test_halves_whose_noise_the_filter_keeps_are_known_for_it():
    """A filter that keeps the share k of the noise, without bias: E (C - truth)^2 is k^2 of the raw one.

    The best w is the whole (only C), its error k sqrt(V / 2); a naive half difference of D(A) and D(B) says the same
    here, which the test above denies it. 160 000 pixels: sigma of the square below 0.4 %.
    """
    rng = np.random.default_rng(5)
    noise = rng.standard_normal((2, 400, 400))
    mixed = mixture(1 + noise, 1 + 0.6 * noise)
    share, error = mixed.share, mixed.error
    assert share.mean() > 0.9
    assert error**2 == pytest.approx(0.36 / 2, rel=0.03)


def test_each_part_of_a_picture_is_mixed_by_its_own_errors():
    """A filter that is right on the left and far off on the right: denoised there, raw here, away from the border.

    The left share is a ratio of two sums of 33 x 33 squares: 6 % of noise, 9 % at a border, which mirrors half of them,
    and nothing above 1. The right one is 0.005, known far better.
    """
    rng = np.random.default_rng(6)
    truth = np.ones((120, 300))
    cleaned = truth + np.where(np.arange(300) < 150, 0.0, 3.0)
    share = mixture(truth + 0.3 * rng.standard_normal((2, 120, 300)), np.stack([cleaned] * 2)).share
    assert share[:, :120].min() > 0.6
    assert share[:, :120].mean() > 0.95
    assert share[:, 180:].max() < 0.05


def test_a_filter_that_does_nothing_is_not_trusted():
    halves = np.random.default_rng(4).standard_normal((2, 100, 100))
    assert mixture(halves, halves).error == pytest.approx(math.sqrt(0.5), rel=0.05)


@pytest.mark.skipif(not available(), reason="Open Image Denoise is not installed: pip install 'qsim[denoise]'")
def test_denoising_helps_where_it_says_so():
    """A matt plate under sun and sky: the stated error of a denoised frame covers its distance from the truth."""
    made = plate(Spin((0, 0, 1), 200.0), light=SunSky(), camera=CAMERA.resized(96, 132))
    raw, clean = (renderer(made, budget=Budget(8, 2, denoise=on)).frame(0, with_truth=False) for on in (False, True))
    converged = renderer(made, seed=9, budget=Budget(512, 2)).frame(0, with_truth=False).radiance
    distance = math.sqrt(np.mean((clean.radiance - converged) ** 2))
    assert distance < 0.7 * raw.error
    assert clean.error == pytest.approx(distance, rel=0.2)


@pytest.mark.skipif(not available(), reason="Open Image Denoise is not installed: pip install 'qsim[denoise]'")
def test_the_denoiser_is_tried_beside_the_middle_of_a_large_frame():
    """A lamp fills the middle, which has no noise at all: the error asked for holds for the whole frame."""
    camera = CAMERA.resized(256, 512)
    lamp = Body("lamp", square(200 / camera.focal_pixels * 4), Glow(0.3))
    leaves = Texture(np.random.default_rng(1).random((96, 96)), nearest=True)
    made = scene(Body("wall", square(12, -1), Diffuse(leaves)), lamp, light=SunSky(), camera=camera)
    chosen = choose_budget(made, psnr=42, denoise=True)
    frame = Renderer(made, budget=chosen).frame(3, with_truth=False)
    white = white_in(frame.radiance)
    assert decibels(white, error_at(white, frame.errors_at)) > 41


@pytest.mark.skipif(not available(), reason="Open Image Denoise is not installed: pip install 'qsim[denoise]'")
def test_a_denoised_trial_with_far_less_noise_than_the_pilots_is_not_believed():
    """Its windows have missed the rare, bright paths that the pilots found; denoising knows of none."""
    made = plate(None, light=SunSky(), camera=replace(CAMERA, height=48, width=64))
    loaded, allowed = pilot.Pilot.of(made, 2000.0, 0.0, 1, 0), Allowed(white=10.0, target=0.02)
    lucky, plain = (
        pilot.denoised_samples(loaded, 1, 2, allowed, 1.0, 5000, None, lambda n, noise=noise: Errors(noise, noise))[0]
        for noise in (100.0, 0.0)
    )
    assert lucky is None
    assert plain is not None


def test_denoising_without_the_package_is_refused(monkeypatch):
    from qsim.rendering import denoiser

    monkeypatch.setattr(denoiser, "available", lambda: False)
    with pytest.raises(ValueError, match="Open Image Denoise is missing"):
        renderer(plate(None), budget=Budget(2, 1, denoise=True)).frame(0)


def test_effects_left_out_are_listed_with_their_size():
    text = explain(choose_budget(plate(None), psnr=25, denoise=False))
    for word in ("depth of field", "diffraction", "Airy disk", "bounces", "samples", "motion blur"):
        assert word in text
    assert explain(Budget()) == ""
