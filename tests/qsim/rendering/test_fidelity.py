"""The choice of a budget: the requested error holds, without waste, for motion, shadows and late bodies."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from small_scenes import CAMERA, plate, renderer, scene, square

from qsim import colour, scenes
from qsim.clip.clamped_error import Errors, Stated, error_at, white_in
from qsim.rendering import fidelity
from qsim.rendering.budget import Allowed, Budget, Finding, blur_error, explain
from qsim.rendering.fidelity import Noise, choose_budget, shortfall
from qsim.rendering.renderer import Renderer
from qsim.scene import Body, Diffuse, Glow, PointLight, Scene, Spin, SunSky, Translation


def test_no_motion_needs_one_instant():
    assert blur_error(0.0, 1) == 0
    chosen = choose_budget(plate(None, light=SunSky()), shutter=1.0, psnr=30, denoise=False)
    assert chosen.sub_frames == 1
    assert not chosen.sharp


@pytest.mark.parametrize("psnr", [25.0, 32.0, 42.0])
def test_the_requested_error_is_reached_without_waste(psnr):
    made = plate(Spin((0, 0, 1), 200.0), light=SunSky())
    chosen = choose_budget(made, psnr=psnr, denoise=False)
    frames = [Renderer(made, budget=chosen).frame(t, with_truth=False) for t in (1, 9)]
    white = white_in(np.stack([frame.radiance for frame in frames]))
    reached = colour.psnr(white, math.sqrt(np.mean([error_at(white, frame.errors_at) ** 2 for frame in frames])))
    assert psnr - 1 < reached < psnr + 10  # samples come in even squares: 4, 16, 36


def test_more_light_on_the_sensor_needs_more_samples():
    made = plate(Spin((0, 0, 1), 200.0), light=SunSky())
    plain, bright = (choose_budget(made, psnr=25, ppp=ppp, denoise=False) for ppp in (None, 300.0))
    assert bright.samples > plain.samples
    assert "the sensor at 300 photons" in explain(bright.findings)


def test_errors_that_repeat_in_all_frames_of_a_code_have_a_stricter_limit(monkeypatch):
    """A code of 16 frames averages their noise: bounces, and frames that are denoised or shared, may err a quarter."""
    made = plate(Spin((0, 0, 1), 200.0), light=SunSky())
    limits = []

    def denoised(*arguments):
        limits.append(arguments[3])
        return None, Finding("denoiser", "off", "")

    def shared(_, need, *__):
        limits.append(need.allowed)
        return need.alone, Finding("reuse", "off", "")

    monkeypatch.setattr(fidelity, "denoised_samples", denoised)
    monkeypatch.setattr(fidelity, "shared_samples", shared)
    single, several = (choose_budget(made, psnr=25, ppp=300, frames=2, planes=planes) for planes in (1, 16))
    sensor = limits[0].sensor
    assert [limit.sensor for limit in limits] == pytest.approx([sensor] * 2 + [sensor / 4] * 2, rel=0.02)
    assert several.left_out <= fidelity.SHARE * limits[2].sensor
    assert several.samples < 2 * single.samples  # not 16 times as many
    assert "errors that repeat within a code" in explain(several.findings)
    assert "errors that repeat within a code" not in explain(single.findings)


def test_bounces_follow_the_scene():
    """One matt plate in the open needs few bounces; the inside of a bright corner needs more."""
    open_air = choose_budget(scene(Body("plate", square(1.5), Diffuse(0.5))), psnr=30, denoise=False)
    lamp = Body("lamp", square(0.4, -0.9), Glow(20.0))
    walls = [Body(f"wall{i}", square(2.2, -1.1), Diffuse(0.95), turned) for i, turned in enumerate(BOX)]
    closed = choose_budget(Scene("box", 0, CAMERA, (), (lamp, *walls)), psnr=30, denoise=False)
    assert open_air.bounces < closed.bounces
    assert "bounces" in explain(closed.findings)


BOX = [Spin((0, 1, 0), 0.0, angle) for angle in (0.0, math.pi / 2, -math.pi / 2)] + [
    Spin((1, 0, 0), 0.0, angle) for angle in (math.pi / 2, -math.pi / 2)
]


def test_an_open_shutter_gets_an_odd_number_of_instants():
    made = plate(Spin((0, 0, 1), 400.0), light=PointLight((1, 2, 4), 30.0))
    chosen = choose_budget(made, shutter=1.0, psnr=35, denoise=False)
    assert chosen.sub_frames % 2 == 1
    assert chosen.sub_frames > 1
    assert chosen.sharp
    assert "mean of" in explain(chosen.findings)


def test_a_shadow_that_moves_on_a_wall_at_rest_is_blurred_too():
    """Nothing visible moves; a slat beside the lamp casts a shadow that moves across the wall.

    With the chosen instants, the mean over the exposure equals that of many more, to the requested error. With three
    instants, the least number for motion, it does not.
    """
    slat = Body("slat", square(0.15), Diffuse(0.5), Translation((100.0, 0.0, 0.0), (-0.5, 0.0, 2.0)))
    made = scene(Body("wall", square(6, -1), Diffuse(0.7)), slat, light=PointLight((0.0, 0.0, 3.0), 40.0))
    made = replace(made, camera=replace(CAMERA, origin=(0.0, 0.0, 1.5)))
    chosen = choose_budget(made, shutter=1.0, psnr=55, denoise=False)
    assert chosen.sub_frames > 3
    assert chosen.sharp
    assert "light and shadow" in explain(chosen.findings)
    means = {}
    for count in (3, chosen.sub_frames, 45):
        one = renderer(made, shutter=1.0, budget=replace(chosen, samples=64 * count, sub_frames=count))
        means[count] = one.frame(10, with_truth=False).radiance
    allowed = white_in(means[45]) * 10 ** (-55 / 20)
    far = {count: math.sqrt(np.mean((image - means[45]) ** 2)) for count, image in means.items()}
    assert far[chosen.sub_frames] < allowed < far[3]


def held(made: Scene, psnr: float, t: int) -> tuple[Budget, float, float, float]:
    """Return the choice for an open shutter, and rms errors at white: allowed, real (315 instants) and stated."""
    chosen = choose_budget(made, shutter=1.0, psnr=psnr, denoise=False)
    frame = renderer(made, shutter=1.0, budget=chosen).frame(t, with_truth=False)
    many = Budget(8 * 315, chosen.bounces, 315, sharp=False)
    truth = renderer(made, shutter=1.0, seed=1, budget=many).frame(t, with_truth=False).radiance
    white = white_in(truth)
    real = Errors.between(frame.radiance, truth, white).at_white
    return chosen, white * 10 ** (-psnr / 20), real, error_at(white, frame.errors_at)


def test_a_wheel_that_turns_once_in_the_exposure_counts_as_moving():
    """Its flow is 0, and thirds and fifths of a turn look alike for 15 blades only."""
    rate = 2 * math.pi * 2000
    wheel = Body("wheel", square(1.2), Diffuse(0.8), Spin((0, 0, 1), rate))
    chosen, allowed, real, stated = held(scene(Body("wall", square(12, -1), Diffuse(0.1)), wheel), 30, 10)
    assert chosen.sub_frames >= 15
    assert real < allowed
    assert 0.3 < stated / real < 4  # thirds of its instants, for a shape of fourfold symmetry
    assert "0 % of the pixels move" not in explain(chosen.findings)


def test_a_body_that_no_pilot_frame_shows_is_found():
    """It crosses the view in frames 4 to 7; light is rendered in frames 0, 10 and 20 of 21."""
    path = Translation((1650.0, 0.0, 0.0), (-1650.0 * 5.5 / 2000, 0.0, 0.0))
    made = scene(Body("wall", square(12, -1), Diffuse(0.2)), Body("ghost", square(0.5), Diffuse(0.9), path))
    chosen, allowed, real, stated = held(made, 30, 5)
    assert chosen.sub_frames > 3
    assert real < allowed
    assert 0.5 < stated / real < 4


def test_instants_are_extrapolated_beyond_the_trials_up_to_a_stated_limit():
    rest = np.zeros((1, 8, 8))
    count, left, finding = fidelity.fewest_instants(rest, 1.0, lambda k: 27 / k)
    assert 90 <= count <= 96
    assert left == pytest.approx(27 / count)
    assert "light and shadow" in finding.size
    count, left, finding = fidelity.fewest_instants(rest, 1.0, lambda k: 2700 / k)
    assert count == fidelity.MOST_INSTANTS
    assert left > 1
    assert f"the limit of {count} instants is reached" in finding.size


def test_a_pilot_that_misses_rare_paths_by_chance_is_corrected():
    """A caustic that 8 samples missed: errors of 0.001, 0.09 and 0.03 with 8, 32 and 128 samples."""
    halves = [np.array([np.full((1, 4, 4), error), np.full((1, 4, 4), -error)]) + 1 for error in (0.001, 0.09, 0.03)]
    allowed = Allowed(white=100.0, target=0.0025)
    samples, finding = fidelity.fewest_samples(Noise.of(halves, 100.0), 1, allowed, 1.0)
    assert samples >= 128 * (0.03 / 0.0025) ** (1 / 0.75) * 0.99
    assert "expected" in finding.size


def test_later_bounces_are_part_of_the_stated_error():
    cheap = Budget(8, 2)
    errors = [
        renderer(plate(None), budget=b).frame(0, with_truth=False).error for b in (cheap, replace(cheap, left_out=0.3))
    ]
    assert errors[1] == pytest.approx(math.hypot(errors[0], 0.3))


def test_a_clip_that_misses_the_requested_psnr_is_reported():
    low = Stated(38.9, 30.0, "white")
    assert shortfall(replace(low, psnr=39.6), 40) == shortfall(None, 40) == ""
    assert "38.9 dB below white, clamped there; 30.0 dB unclamped, where 40 were requested" in shortfall(low, 40)


def test_bounces_that_no_pilot_tried_are_not_stated_as_zero():
    full = np.full((1, 4, 4), 2.0)
    bounces, cut, finding = fidelity.fewest_bounces(lambda depth: full - 0.1, full, Allowed(5.0, 0.03))
    assert bounces == fidelity.DEEPEST
    assert Errors.between(cut, full, 5.0).plain == pytest.approx(0.1)
    assert "deeper ones were not tried" in finding.size


def test_equal_arguments_give_equal_budgets():
    made = plate(Spin((0, 0, 1), 200.0), light=SunSky())
    assert choose_budget(made, psnr=25) == choose_budget(made, psnr=25)


def test_a_lamp_behind_a_wall_is_reported():
    made = scene(Body("wall", square(50, -1), Diffuse(0.5)), light=PointLight((0, 0, -2), 1.0))
    with pytest.raises(ValueError, match="the pilot saw no light"):
        choose_budget(made)


@pytest.mark.parametrize("psnr", [0.0, 200.0])
def test_a_psnr_out_of_range_is_refused(psnr):
    with pytest.raises(ValueError, match="10 to 80 dB"):
        choose_budget(plate(None), psnr=psnr)


@pytest.mark.parametrize("ppp", [0.0, -1.0, math.nan, math.inf])
def test_a_light_level_that_no_sensor_sees_is_refused(ppp):
    with pytest.raises(ValueError, match="ppp: expected photons per pixel above 0, or None"):
        choose_budget(plate(None), ppp=ppp)


@pytest.mark.parametrize("planes", [0, 0.5, math.nan, math.inf])
def test_a_code_without_frames_is_refused(planes):
    with pytest.raises(ValueError, match="planes: expected frames in a code from 1 up"):
        choose_budget(plate(None), ppp=3.0, planes=planes)


@pytest.mark.parametrize("efficiency", [0.0, -0.5, 1.2, math.nan])
def test_an_efficiency_that_no_sensor_has_is_refused(efficiency):
    with pytest.raises(ValueError, match="quantum_efficiency: expected a number above 0, at most 1"):
        choose_budget(plate(None), ppp=3.0, quantum_efficiency=efficiency)


def test_the_surroundings_count_in_the_largest_blur_circle():
    """The body is in focus, 4 m away; what is at infinity is not."""
    camera = replace(CAMERA, f_number=0.5, aperture_blur=True)
    circle = float(camera.circle_of_confusion(np.array(1e9)))
    depth_of_field = fidelity.effects_left_out(camera, [{"depth": np.array([[4.0, np.inf]])}])[0]
    assert f"largest blur circle {circle:.2g} px" in depth_of_field.size
    near = fidelity.effects_left_out(camera, [{"depth": np.array([[4.0, 4.0]])}])[0]
    assert "largest blur circle 0 px" in near.size


def test_effects_left_out_are_listed_with_their_size():
    text = explain(choose_budget(plate(None), psnr=25, denoise=False).findings)
    for word in ("depth of field", "diffraction", "Airy disk", "bounces", "samples", "motion blur"):
        assert word in text
    assert explain(Budget().findings) == ""


def test_a_clip_without_frames_is_refused():
    with pytest.raises(ValueError, match="frames: expected a whole number from 1 up, got 0"):
        choose_budget(scenes.load("plain").resized(16, 16), frames=0)
