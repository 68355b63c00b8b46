"""Rendering under light that flickers: exact strengths, truth, blur and the budget."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_scenes import CAMERA, CHEAP, plate, renderer, scene, square

from qsim.clip.clamped_error import stated
from qsim.rendering.budget import Budget, blur_left, instants, light_windows
from qsim.rendering.clip_rendering import render_clip
from qsim.rendering.fidelity import choose_budget, flickering
from qsim.rendering.pilot import Pilot
from qsim.scene import (
    AreaLamp,
    Body,
    Constant,
    Diffuse,
    EnvironmentImage,
    Glow,
    Mains,
    PointLight,
    PulseWidth,
    RectifiedSine,
    Scene,
    Translation,
)

LED = PulseWidth(1700.0, 0.3, 0.4)
WALL = Body("wall", square(12, -1), Diffuse(0.5))
LIGHTS = {
    "even": lambda flicker: Constant(0.7, flicker),
    "lamp": lambda flicker: AreaLamp((1, 2, 3), (0, 0, 0), 0.4, 0.6, 5.0, flicker=flicker),
    "point": lambda flicker: PointLight((1, 1, 3), 2.0, flicker=flicker),
    "picture": lambda flicker: EnvironmentImage(np.linspace(0.1, 2, 32).reshape(4, 8), 0.5, flicker=flicker),
}


@pytest.mark.parametrize("kind", [*LIGHTS, "glow"])
@pytest.mark.parametrize("shutter", [0.0, 0.37, 1.0])
def test_radiance_at_rest_is_the_steady_one_times_the_mean_strength(kind, shutter):
    """Equal paths: the ratio is exact but for single precision, in the frame and in its sharp instant."""
    bodies = [WALL] + [Body("tube", square(0.4, 1), Glow(3.0, LED))] * (kind == "glow")
    steady = [WALL] + [Body("tube", square(0.4, 1), Glow(3.0))] * (kind == "glow")
    lights = (LIGHTS[kind](LED),) if kind in LIGHTS else ()
    calm = (LIGHTS[kind](None),) if kind in LIGHTS else ()
    made = renderer(Scene("test", 0, CAMERA, lights, tuple(bodies)), Budget(8, 2, 3), shutter=shutter)
    other = renderer(Scene("test", 0, CAMERA, calm, tuple(steady)), Budget(8, 2, 3), shutter=shutter)
    strength = made.strengths(5)["body1" if kind == "glow" else "light0"]
    assert np.ptp(strength) > 0.1
    for t in (3, 0):
        seen = made.frame(t, with_truth=False)
        expected = other.frame(t, with_truth=False)
        np.testing.assert_allclose(seen.radiance, expected.radiance * strength[t], rtol=2e-6, atol=1e-9)
        assert seen.error == pytest.approx(expected.error * strength[t], rel=1e-4)
        if shutter > 0:
            np.testing.assert_allclose(seen.sharp, expected.sharp * strength[t], rtol=2e-6, atol=1e-9)


def test_lights_of_different_flicker_add():
    """Frames in any order are sums of what each light adds, times its strength; crops see the same."""
    first = Mains(100, 0.9, 1.0)
    second = RectifiedSine(120, 0.3)
    lamps = [LIGHTS["lamp"](first), LIGHTS["point"](second)]

    def seen(lights, t, crop=None):
        return renderer(Scene("test", 0, CAMERA, tuple(lights), (WALL,)), crop=crop).frame(t, with_truth=False).radiance

    dark = [replace(lamps[0], radiance=0.0), replace(lamps[1], intensity=0.0)]
    strengths = renderer(Scene("test", 0, CAMERA, tuple(lamps), (WALL,))).strengths(18)
    alone = [replace(light, flicker=None) for light in lamps]
    each = [seen([alone[0], dark[1]], 17), seen([dark[0], alone[1]], 17)]
    expected = each[0] * strengths["light0"][17] + each[1] * strengths["light1"][17]
    whole = seen(lamps, 17)
    np.testing.assert_allclose(whole, expected, rtol=1e-5)
    assert seen(lamps, 17, (3, 5, 7, 11)).mean() == pytest.approx(whole[3:10, 5:16].mean(), rel=0.05)


def test_flicker_within_an_exposure_is_no_blur_and_flashes_freeze_motion():
    """Under a flash of a ninth of the exposure, a plate that moves 3 px is nearly sharp."""
    made = renderer(plate(None, Constant(0.7, PulseWidth(3000, 0.2))), Budget(72, 2, 9), shutter=1.0)
    calm = renderer(plate(None), Budget(72, 2, 9), shutter=1.0)
    each = [made.scene.flickers["light0"].mean(*np.array(w)) for w in light_windows(made.instants(0), made.exposure)]
    assert max(each) > 1.5 * min(each)
    means = made.means(made.instants(0), made.budget, made.key(0))
    assert blur_left(means, 9) < 0.005 * means[0].mean()
    uneven = np.sqrt(np.mean(np.square(each)))  # independent noise of each instant, in proportion to its light
    assert made.frame(0).error == pytest.approx(calm.frame(0).error * uneven, rel=0.15)
    flight = Translation((600.0, 0.0, 0.0))
    flash = PulseWidth(2000.0, 1 / 9, 2 * np.pi / 18)  # a ninth of the exposure, around its middle
    apart = []
    for light, count in ((Constant(0.7, flash), 27), (Constant(0.7), 9)):
        seen = renderer(plate(flight, light), Budget(8 * count, 2, count), shutter=1.0)
        wide, sharp = (seen.halves(at, seen.budget, seen.key(0, 20 + len(at))) for at in (seen.instants(0), [0.0]))
        apart.append(np.mean(np.prod(wide - sharp, axis=0)))  # a squared difference without bias from noise
    assert apart[0] < 0.1 * apart[1]


@pytest.mark.parametrize("count", [1, 2, 3, 4, 9, 15, 25])
def test_the_parts_of_an_exposure_cover_it_evenly(count):
    windows = light_windows(instants(0.3, 0.02, count), 0.02)
    edges = sorted({round(edge, 12) for window in windows for edge in window})
    assert (edges[0], edges[-1]) == pytest.approx((0.29, 0.31))
    assert np.diff(edges) == pytest.approx(0.02 / (count // 3 if count % 3 == 0 else count))
    assert all(a <= t <= b for (a, b), t in zip(windows, instants(0.3, 0.02, count), strict=True))


def test_a_lamp_that_is_dark_in_first_middle_and_last_frame_does_not_fool_the_budget(tmp_path):
    """At 400 fps, an LED of 200 Hz lights every second frame only: the request holds, over all frames."""
    led = PulseWidth(200.0, 0.3, -np.pi / 2 * 1.6)
    made = plate(None, LIGHTS["lamp"](led))
    loaded = Pilot.of(made, 400.0, 0.0, 9, 0)
    strengths = loaded.renderer.strengths(9)["light0"]
    assert strengths[[0, 4, 8]].max() == 0
    assert loaded.middle == int(np.argmax(strengths))
    budget = choose_budget(made, frame_rate=400.0, frames=9, psnr=36, denoise=False)
    assert "light0 0 to 2 of its mean" in next(f.size for f in budget.findings if f.effect == "flicker")
    clip = render_clip(made, tmp_path / "clip", frames=9, frame_rate=400.0, budget=budget)
    assert stated(clip.info).psnr >= 35.5
    np.testing.assert_array_equal(clip.strengths["light0"], strengths)
    means = np.array([clip[t].mean() for t in range(9)])
    np.testing.assert_allclose(means / means.max(), strengths / strengths.max(), atol=0.01)
    assert clip.info.flicker["light0"].kind == "PulseWidth"


def test_a_lamp_that_flashes_in_few_frames_gets_a_budget():
    """At 2000 fps, an LED of 100 Hz lights 2 of 40 frames: its white is that of the clip, a mean of all frames."""
    made = plate(None, Constant(0.7, PulseWidth(100.0, 0.02)))
    loaded = Pilot.of(made, 2000.0, 0.0, 40, 0)
    strengths = loaded.renderer.strengths(40)["light0"]
    assert np.flatnonzero(strengths).tolist() == [0, 20]
    assert strengths[list(loaded.times)].max() == strengths.max()
    assert strengths[loaded.counted(np.array(loaded.times))].mean() == pytest.approx(strengths.mean(), rel=0.1)
    steady = renderer(plate(None)).frame(0, with_truth=False).radiance.mean()
    chosen = choose_budget(made, frames=40, psnr=25, denoise=False)
    assert chosen.white == pytest.approx(2.5 * strengths.mean() * steady, rel=0.15)


def test_the_budget_knows_that_flashes_spoil_the_average_of_instants():
    """Nine instants of which three have light average as little noise as three: 1.7 times that of nine."""
    loaded = Pilot.of(plate(None, Constant(0.7, PulseWidth(2000.0, 1 / 3, -np.pi))), 2000.0, 1.0, 5, 0)
    assert loaded.unevenness(9) == pytest.approx(np.sqrt(3), rel=1e-6)
    assert loaded.unevenness(3) == pytest.approx(1)
    assert Pilot.of(plate(None), 2000.0, 1.0, 5, 0).unevenness(9) == 1


def test_motion_within_three_instants_of_flickering_light_is_listed():
    """No stated error counts it: the plate moves 3 px in an exposure of K instants, 9 / K px in three of them."""
    made = plate(Translation((600.0, 0.0, 0.0)), Constant(0.7, PulseWidth(2000.0, 1 / 9)))
    chosen = choose_budget(made, shutter=1.0, frames=2, psnr=25, denoise=False)
    found = next(f for f in chosen.findings if f.effect == "flicker and motion")
    assert found.chosen == f"light averaged over 3 of {chosen.sub_frames} instants"
    assert float(found.size.split(" px ")[0].split()[-1]) == pytest.approx(9 / chosen.sub_frames, rel=0.1)
    assert "not counted in the stated error" in found.size
    strengths = {"light0": np.ones(2)}
    assert [f.effect for f in flickering(strengths, np.zeros((1, 2, 2)), 1)] == ["flicker"]
    assert flickering({}, np.ones((1, 2, 2)), 9) == ()


def test_steady_light_has_no_entry(tmp_path):
    clip = render_clip(scene(WALL), tmp_path / "clip", frames=1, budget=CHEAP)
    assert not clip.info.flicker
    assert clip.strengths == {}
