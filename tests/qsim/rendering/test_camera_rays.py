"""Tests that rendered pictures, rays and ground truth agree with the camera: thin lens, distortion and fall-off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_scenes import CAMERA, RATE, plate, renderer, scene, square
from stats import critical_z

from qsim.backend import choose
from qsim.optics.camera import Camera
from qsim.optics.lens import Lens
from qsim.optics.radiometry import expected_photons
from qsim.optics.zoom import Zoom
from qsim.rendering.budget import Budget
from qsim.rendering.camera_rays import CameraRays
from qsim.scene import Body, Constant, Glow, Scene, Spin, Still, Translation

BENT = Lens(-0.25, 0.06, (-0.2,), (0.06, -0.04))


def random_camera(rng: np.random.Generator, **changes) -> Camera:
    """Return a wide camera with any lens that it allows: radial, with more terms, or with all of them."""
    lens = Lens(*rng.uniform(-0.2, 0.4, 2), (float(rng.uniform(-0.5, 0.1)),), tuple(rng.uniform(-0.1, 0.1, 2)))
    some = int(rng.integers(3))
    if some:
        lens = replace(lens, k3=float(rng.uniform(0, 0.1)), k4=float(rng.uniform(0, 0.1)))
    if some == 2:
        p1, p2, aspect = rng.uniform((-0.03, -0.03, 0.8), (0.03, 0.03, 1.25))
        lens = replace(lens, p1=float(p1), p2=float(p2), aspect=float(aspect))
    return replace(CAMERA, focal_length=float(rng.uniform(1.6e-3, 3e-3)), lens=lens, **changes)


def glowing(side: float, place: tuple[float, float, float], camera: Camera) -> Scene:
    """Return one glowing square of `side` [m] that faces the camera, in the dark."""
    return scene(Body("spot", square(side), Glow(1.0), Still(place)), light=Constant(0.0), camera=camera)


def moments(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the centre (x, y) [px] of a picture's light and its variance along x and y [px^2]."""
    y, x = np.mgrid[: picture.shape[0], : picture.shape[1]] + 0.5
    share = picture / picture.sum()
    centre = np.array([(share * x).sum(), (share * y).sum()])
    return centre, np.array([(share * (x - centre[0]) ** 2).sum(), (share * (y - centre[1]) ** 2).sum()])


def focused(rng: np.random.Generator, beyond: bool) -> tuple[Camera, float]:
    """Return a thin lens, and a depth before or behind its focus whose blur is 5 to 26 px wide."""
    while True:
        camera = Camera(
            focal_length=float(rng.uniform(5e-3, 30e-3)),
            f_number=float(rng.uniform(0.8, 4)),
            pixel_pitch=2e-5,
            height=41,
            width=44,
            origin=(0.0, 0.0, 0.0),
            target=(0.0, 0.0, -1.0),
            aperture_blur=True,
            focus_distance=float(rng.uniform(0.1, 0.6)),
        )
        depth = camera.focus * float(rng.uniform(1.05, 4) if beyond else rng.uniform(0.3, 0.95))
        if 5 < camera.circle_of_confusion(np.array(depth)) < 26:
            return camera, depth


@pytest.mark.parametrize("draws", [2, pytest.param(30, marks=pytest.mark.slow)])
def test_a_small_bright_spot_is_as_wide_as_the_circle_of_confusion(draws):
    """Along an axis a disk of diameter c has the variance c^2 / 16, a square spot o^2 / 12 and a pixel 1 / 12.

    Limits are those of n independent samples that meet the spot; grids of samples have less noise. A disk has a
    kurtosis of 2, a spot and a pixel less: the variance along two axes has a relative sigma of at most (2 n)^-1/2.
    """
    rng = np.random.default_rng(11 + draws)
    for beyond in [False, True] * draws:
        camera, depth = focused(rng, beyond)
        pupil = 2 * camera.pupil_radius
        f = camera.focal_length
        s = camera.focus
        circle = pupil * f * abs(depth - s) / (depth * (s - f)) / camera.pixel_pitch
        own = circle / 2
        place = (*(rng.uniform(-4, 4, 2) * depth / camera.focal_pixels).tolist(), -depth)
        made = glowing(own * depth / camera.focal_pixels, place, camera)
        picture = renderer(made, budget=Budget(2304, 1)).frame(0).radiance.astype(np.float64)
        centre, variance = moments(picture)
        n = 2 * 2304 * own**2
        z = critical_z(checks=8 * draws)
        np.testing.assert_allclose(centre, camera.project(np.array(place))[0], atol=z * np.sqrt(variance.max() / n))
        found = 4 * np.sqrt(variance.mean() - own**2 / 12 - 1 / 12)
        assert found == pytest.approx(circle, rel=z * variance.mean() * 8 / circle**2 / np.sqrt(2 * n))
        assert picture.sum() == pytest.approx(own**2, rel=z / np.sqrt(n))  # none of its light is lost


def test_the_rays_of_a_kernel_are_those_of_the_camera():
    """Through pixel centres, over random lenses; single precision leaves 1e-6 of a slope."""
    rng = np.random.default_rng(12)
    made = renderer(plate(None))
    mi = made.mi
    y, x = np.mgrid[:24, :33] + 0.5
    for _ in range(20):
        camera = random_camera(rng)
        rays = CameraRays(mi, camera).through(np.eye(4), mi.Point2f(x.ravel(), y.ravel()), None)
        found = np.array(rays.d).T
        found = found / found[:, 2:]
        np.testing.assert_allclose(found, camera.directions().reshape(-1, 3), atol=2e-6)


def test_a_spot_is_rendered_where_the_camera_projects_it():
    rng = np.random.default_rng(13)
    for _ in range(6):
        camera = random_camera(rng)
        pixel = rng.integers((3, 3), (21, 30))
        place = camera.pose()[:3, :3] @ camera.directions()[tuple(pixel)] * 2.5 + camera.pose()[:3, 3]
        picture = renderer(glowing(0.08, tuple(place), camera), budget=Budget(1024, 1)).frame(0).radiance
        centre, _ = moments(picture.astype(np.float64))
        np.testing.assert_allclose(camera.project(place)[0], pixel[::-1] + 0.5, atol=1e-9)
        np.testing.assert_allclose(centre, pixel[::-1] + 0.5, atol=0.05)


def test_the_truth_of_a_static_scene_is_that_of_the_distorting_camera():
    """Depth and bodies lie on the rays, and flow ends where the next camera projects the same points."""
    rng = np.random.default_rng(14)
    for _ in range(6):
        motion = Spin((0, 1, 0.3), float(rng.uniform(20, 60))) @ Translation(tuple(rng.uniform(-60, 60, 3)))
        camera = random_camera(rng, motion=motion)
        frame = renderer(plate(None, camera=camera)).frame(2)
        pose = camera.pose(2 / RATE)
        rays = camera.directions() @ pose[:3, :3].T
        points = pose[:3, 3] + rays * frame.depth[..., None].astype(np.float64)
        y, x = np.mgrid[:24, :33] + 0.5
        for later, flow in ((3 / RATE, frame.flow), (1 / RATE, frame.flow_back)):
            pixels, _ = camera.project(points, later)
            np.testing.assert_allclose(flow, [pixels[..., 0] - x, pixels[..., 1] - y], atol=1e-4)
        ends = np.stack([x, y]) + frame.flow
        inside = (ends >= 0).all(axis=0) & (ends[0] <= 33) & (ends[1] <= 24)
        assert not frame.valid[~inside].any()
        on = pose[:3, 3] - rays * (pose[2, 3] / rays[..., 2])[..., None]  # where the rays meet the plane of the plate
        within = np.abs(on[..., :2]).max(axis=-1) - 0.8
        clear = np.abs(within) > 1e-4
        assert ((frame.body_id == 1) == (within < 0))[clear].all()


def zooming() -> Camera:
    """Return a wide camera that turns, and whose lens changes from frame to frame."""
    wide = Lens(-0.2, 0.05, (-0.2,), (0.02, 0.0))
    far = Lens(0.1, 0.0, (-0.2,), (-0.03, 0.05), p1=0.02, aspect=1.1)
    zoom = Zoom((0.0, 2 / RATE, 5 / RATE), (0.9, 1.3, 1.1), (wide, far, replace(wide, k3=0.02)))
    return replace(CAMERA, focal_length=2e-3, lens=wide, zoom=zoom, motion=Spin((0, 1, 0.3), 30.0))


def test_rays_and_truth_follow_a_lens_that_changes():
    camera = zooming()
    made = renderer(plate(None, camera=camera))
    mi = made.mi
    y, x = np.mgrid[:24, :33] + 0.5
    for t in (0.0, 1.3 / RATE, 4 / RATE, 9.0):
        rays = CameraRays(mi, camera).at(t).through(np.eye(4), mi.Point2f(x.ravel(), y.ravel()), None)
        found = np.array(rays.d).T
        np.testing.assert_allclose(
            found / found[:, 2:], camera.at(t).directions().reshape(-1, 3), atol=2e-6, err_msg=str(t)
        )
    frame = made.frame(2)
    pose = camera.pose(2 / RATE)
    rays = camera.at(2 / RATE).directions() @ pose[:3, :3].T
    points = pose[:3, 3] + rays * frame.depth[..., None].astype(np.float64)
    for later, flow in ((3 / RATE, frame.flow), (1 / RATE, frame.flow_back)):
        pixels, _ = camera.project(points, later)
        near = np.isfinite(frame.depth)
        np.testing.assert_allclose(flow[:, near], [(pixels[..., 0] - x)[near], (pixels[..., 1] - y)[near]], atol=1e-4)
    ends = np.stack([x, y]) + frame.flow
    assert not frame.valid[~((ends >= 0).all(axis=0) & (ends[0] <= 33) & (ends[1] <= 24))].any()


def test_a_spot_is_rendered_where_a_changing_lens_projects_it():
    camera = zooming()
    t = 2
    pose = camera.pose(t / RATE)
    place = pose[:3, :3] @ camera.at(t / RATE).directions()[4, 28] * 2.5 + pose[:3, 3]
    made = renderer(glowing(0.08, tuple(place), camera), budget=Budget(1024, 1))
    centre, _ = moments(made.frame(t).radiance.astype(np.float64))
    np.testing.assert_allclose(centre, (28.5, 4.5), atol=0.05)
    assert np.abs(camera.project(place, 0.0)[0] - (28.5, 4.5)).max() > 1  # elsewhere in frame 0


def test_light_behind_a_lens_falls_off_once():
    """An even scene: the photons are those of the axis, times the light of the lens at each pixel."""
    camera = replace(CAMERA, focal_length=2e-3, lens=BENT)
    radiance = renderer(scene(light=Constant(0.7), camera=camera)).frame(0).radiance
    np.testing.assert_allclose(radiance, 0.7, rtol=1e-3)
    photons = expected_photons(radiance, camera, 5e-4, origin=(0, 0))
    y, x = np.mgrid[:24, :33] + 0.5
    slopes = np.stack([x - camera.axis[0], y - camera.axis[1]], -1) / camera.focal_pixels
    ideal = replace(camera, lens=None, vignetting=False)
    on_axis = expected_photons(np.full((24, 33), 0.7), ideal, 5e-4)
    np.testing.assert_allclose(photons, on_axis * BENT.illumination(slopes, natural=True), rtol=1e-3)
    part = expected_photons(radiance[5:, 7:], camera, 5e-4, origin=(5, 7))
    np.testing.assert_allclose(part, photons[5:, 7:], rtol=1e-12)


def test_distortion_does_not_change_the_light_of_a_body():
    """A spot wholly inside the picture sends as many photons through any distortion."""
    totals = []
    for lens in (None, Lens(-0.3), Lens(0.5, 0.2), Lens(0.1, shift=(0.1, 0.05)), Lens(p1=0.03, p2=0.06, aspect=0.8)):
        camera = replace(CAMERA.resized(48, 66), lens=lens)
        made = glowing(0.5, (0.6, -0.5, 1.0), camera)
        frame = renderer(made, budget=Budget(256, 1)).frame(0)
        totals.append(expected_photons(frame.radiance, camera, 5e-4, origin=(0, 0)).sum())
    np.testing.assert_allclose(totals, totals[0], rtol=0.01)


def test_an_ideal_lens_changes_no_bit():
    pictures = [renderer(plate(None, camera=replace(CAMERA, lens=lens))).frame(0) for lens in (None, Lens())]
    np.testing.assert_array_equal(pictures[0].radiance, pictures[1].radiance)


def test_the_scalar_engine_refuses_what_it_has_not():
    """Its camera is Mitsuba's own; a thin lens it has, and its blur is ours."""
    camera, depth = focused(np.random.default_rng(15), True)
    made = glowing(0.3 * depth * 7 / camera.focal_pixels, (0.0, 0.0, -depth), camera)
    ours, theirs = (
        moments(renderer(made, budget=Budget(256, 1), engine=choose(name)).frame(0).radiance.astype(np.float64))[1]
        for name in (None, "scalar")
    )
    assert ours.mean() == pytest.approx(theirs.mean(), rel=0.03)
    for lens in (Lens(0.1), Lens(shift=(0.1, 0.0)), Lens(aspect=1.1)):
        made = plate(None, camera=replace(CAMERA, lens=lens))
        with pytest.raises(ValueError, match=r"which the scalar engine .* has no distortion and no shift"):
            renderer(made, engine=choose("scalar")).frame(0)
    with pytest.raises(ValueError, match=r"Camera.zoom: Mitsuba's own camera, .* has no distortion and no zoom"):
        renderer(
            plate(None, camera=replace(CAMERA, zoom=Zoom((0.0, 1.0), (3.0, 4.0), (Lens(), Lens())))),
            engine=choose("scalar"),
        ).frame(0)
    falling = plate(None, camera=replace(CAMERA, lens=Lens(falloff=(-0.3,))))
    assert renderer(falling, engine=choose("scalar")).frame(0).radiance.any()
