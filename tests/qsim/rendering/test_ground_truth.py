"""Ground truth: flow, validity and depth against analysis, for rigid, deforming and resting bodies."""

from __future__ import annotations

import math

import numpy as np
import pytest
from small_scenes import CAMERA, RATE, plate, renderer, scene, square

from qsim.optics.camera import Camera
from qsim.rendering.budget import Budget
from qsim.scene import (
    Body,
    Diffuse,
    EnvironmentImage,
    Joint,
    Mesh,
    Pendulum,
    Skinned,
    Spin,
    Still,
    Texture,
    Translation,
)
from qsim.scene.shapes import sheet


def test_a_translating_plate_flows_by_focal_length_times_speed_over_depth():
    speed = np.array([60.0, -35.0, 0.0])
    frame = renderer(plate(Translation(tuple(speed)))).frame(0)
    on = frame.body_id == 1
    assert on.sum() > 50
    expected = CAMERA.focal_pixels * speed[:2] * (1, -1) / RATE / 4.0
    assert np.abs(frame.flow[:, on] - expected[:, None]).max() < 0.02
    assert np.abs(frame.flow_back[:, on] + expected[:, None]).max() < 0.02
    assert np.abs(frame.flow[:, ~on]).max() == 0


def test_a_spinning_plate_flows_along_chords():
    """A point at r turns by w / rate: its flow is (R - 1) r in the image, where y points down."""
    angle = 0.11
    frame = renderer(plate(Spin((0, 0, 1), angle * RATE))).frame(0)
    on = frame.body_id == 1
    y, x = np.mgrid[:24, :33] + 0.5
    right = x[on] - 16.5
    up = 12 - y[on]
    turned = np.cos(angle) * right - np.sin(angle) * up, np.sin(angle) * right + np.cos(angle) * up
    expected = np.stack([turned[0] - right, -(turned[1] - up)])
    assert np.abs(expected).max() > 0.5
    assert np.abs(frame.flow[:, on] - expected).max() < 0.02


def sampled(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Bilinear values at pixel coordinates (centres at half)."""
    from scipy.ndimage import map_coordinates

    return map_coordinates(image, [y - 0.5, x - 0.5], order=1, mode="nearest")


def test_going_forward_and_back_returns_where_valid():
    camera = CAMERA.resized(48, 66)
    views = renderer(plate(Spin((0.2, 0.3, 1), 300.0), camera=camera))
    first = views.frame(3)
    second = views.frame(4)
    y, x = np.mgrid[:48, :66] + 0.5
    # Away from outlines, where bilinear flow mixes two bodies.
    same = np.ones((48, 66), bool)
    ends = x + first.flow[0], y + first.flow[1]
    for dy in (-0.5, 0.5):
        for dx in (-0.5, 0.5):
            row = np.floor(ends[1] + dy - 0.0)
            column = np.floor(ends[0] + dx - 0.0)
            inside = (row >= 0) & (row < 48) & (column >= 0) & (column < 66)
            seen = second.body_id[row.clip(0, 47).astype(int), column.clip(0, 65).astype(int)]
            same &= inside & (seen == first.body_id)
    usable = first.valid & same
    assert usable.mean() > 0.8
    back = np.stack([sampled(second.flow_back[i], *ends) for i in (0, 1)])
    assert np.abs(first.flow + back)[:, usable].max() < 0.02


def test_what_a_plate_uncovers_and_covers_is_not_valid():
    """The plate moves right by 1.5 px per frame and hides the wall just right of it; nothing else changes."""
    step = 1.5
    speed = step * RATE * 4 / CAMERA.focal_pixels
    frame = renderer(plate(Translation((speed, 0, 0)))).frame(0)
    hidden = ~frame.valid & (frame.body_id == 0)
    centres = np.nonzero(hidden)[1] + 0.5
    edge = 16.5 + 0.8 * CAMERA.focal_pixels / 4  # of the plate, in pixels
    assert hidden.any()
    assert ((centres > edge - 0.01) & (centres < edge + step + 0.01)).all()
    assert frame.valid[frame.body_id == 1].all()


def test_what_leaves_the_frame_is_not_valid():
    views = renderer(scene(Body("wall", square(30), Diffuse(0.5), Translation((2 * RATE * 4 / 40, 0, 0)))))
    frame = views.frame(0)
    np.testing.assert_allclose(frame.flow[0], 2.0, atol=0.02)
    assert not frame.valid[:, -2:].any()
    assert frame.valid[:, :-2].all()


def test_colours_move_with_the_flow():
    """Uniform light on a matt plate: frame 1 warped by the flow equals frame 0 within noise and interpolation."""
    camera = CAMERA.resized(60, 80)
    smooth = Texture(0.5 + 0.3 * np.sin(np.linspace(0, 2 * np.pi, 64, endpoint=False))[None, :] * np.ones((64, 1)))
    made = scene(Body("plate", square(8), Diffuse(smooth), Translation((160.0, 60.0, 0))), camera=camera)
    views = renderer(made, budget=Budget(64, 1))
    first = views.frame(0)
    second = views.frame(1)
    assert np.abs(first.flow).max() > 0.4
    y, x = np.mgrid[:60, :80] + 0.5
    difference = (sampled(second.radiance, x + first.flow[0], y + first.flow[1]) - first.radiance)[first.valid]
    stated = math.hypot(first.error, second.error)
    assert np.sqrt(np.mean(difference**2)) < 1.2 * stated + 1e-3
    assert np.sqrt(np.mean((second.radiance - first.radiance) ** 2)) > 2 * stated + 1e-3  # without warping it differs


def test_a_static_scene_is_static():
    views = renderer(plate(None))
    first = views.frame(0)
    second = views.frame(5)
    for name in ("flow", "flow_back"):
        assert (first.truth[name] == 0).all()
    assert first.valid.all()
    assert (first.depth == second.depth).all()
    assert (first.radiance != second.radiance).any()  # every frame has its own noise


def test_a_panning_camera_moves_the_surroundings_too():
    angle = 0.05
    camera = Camera(2e-3, 2.8, 5e-5, 24, 33, origin=(0, 0, 4), motion=Spin((0, 1, 0), angle * RATE))
    frame = renderer(scene(light=EnvironmentImage(np.ones((8, 16))), camera=camera)).frame(0)
    # The camera turns right (about its y axis, which points down), so the picture moves left.
    expected = -camera.focal_pixels * math.tan(angle)
    assert frame.flow[0, 12, 16] == pytest.approx(expected, abs=0.02)
    assert (frame.body_id == -1).all()


class Stretch(Still):
    """A sheet whose x grows linearly: a deformation in closed form."""

    def deform(self, t: float) -> np.ndarray:
        return square(1.6).vertices * (1 + 200.0 * t, 1, 1)


def test_a_deforming_body_carries_its_flow():
    frame = renderer(plate(Stretch())).frame(0)
    on = frame.body_id == 1
    x = np.broadcast_to(np.arange(33) + 0.5 - 16.5, (24, 33))[on]
    assert np.abs(frame.flow[0][on] - x * 200.0 / RATE).max() < 0.02
    assert np.abs(frame.flow[1][on]).max() < 0.02


@pytest.mark.parametrize("seed", range(3))
def test_the_flow_of_a_skinned_body_is_that_of_its_points(seed):
    """Every hit is carried by loops over its triangle's corners, not by the code of skinning, and projected by hand."""
    rng = np.random.default_rng(seed)
    cloth = sheet(1.6, 1.4, 5, 3)
    pivot = (0.1, 0.2, 0.0)
    bones = (Spin((0.2, 0.1, 1), 300.0, 0.1), Pendulum(pivot, (0, 1, 0.3), 0.4, 90.0))
    shares = rng.dirichlet((1, 1), len(cloth.vertices))
    joints = (Joint(bones[0]), Joint(bones[1], 0))
    carrier = Translation((300.0, -200.0, 100.0))
    motion = Skinned(cloth.vertices, joints, np.tile([0, 1], (len(shares), 1)), shares, carrier=carrier)
    views = renderer(scene(Body("wall", square(12, -1)), Body("cloth", cloth, motion=motion)))
    truth = views.frame(2)

    def place(vertex, t):
        outer, inner = (bone.pose(t) for bone in bones)
        both = [outer @ (*cloth.vertices[vertex], 1), outer @ inner @ (*cloth.vertices[vertex], 1)]
        return (shares[vertex] @ both)[:3] + np.multiply(t, (300.0, -200.0, 100.0))

    now, later = (np.array([place(v, t) for v in range(len(shares))]) for t in (2 / RATE, 3 / RATE))
    on = truth.body_id == 1
    seen = 0
    for y, x in np.argwhere(on)[::7]:
        ray = np.array([(x + 0.5 - 16.5), -(y + 0.5 - 12), -CAMERA.focal_pixels]) / CAMERA.focal_pixels
        matches = []
        for face in cloth.faces:
            a, b, c = now[face]
            d, u, v = np.linalg.solve(np.column_stack([ray, a - b, a - c]), a - (0, 0, 4))
            if d > 0 and min(u, v, 1 - u - v) > 1e-3:
                a, b, c = later[face]
                end = a + u * (b - a) + v * (c - a) - (0, 0, 4)
                matches.append((d, CAMERA.focal_pixels * np.array([end[0] / -end[2], -end[1] / -end[2]])))
        if matches:
            seen += 1
            end = min(matches, key=lambda match: match[0])[1]
            start = np.array([x + 0.5 - 16.5, y + 0.5 - 12])
            np.testing.assert_allclose(truth.flow[:, y, x], end - start, atol=0.02)
    assert seen > 10
    assert np.abs(truth.flow[:, on]).max() > 1


def test_a_body_behind_the_camera_next_is_not_valid():
    frame = renderer(plate(Translation((0.0, 0.0, 5.0 * RATE)))).frame(0)
    on = frame.body_id == 1
    assert on.any()
    assert not frame.valid[on].any()
    assert (frame.flow[:, on] == 0).all()


def test_zero_area_triangles_are_never_hit():
    flat = Mesh(
        np.array([[0, 0, 1.0], [1, 0, 1], [0.5, 0, 1], [-1, -1, 0], [1, -1, 0], [0, 1, 0]]), np.arange(6).reshape(2, 3)
    )
    frame = renderer(scene(Body("flat", flat, Diffuse(0.5)))).frame(0)
    assert np.isfinite(frame.radiance).all()
    np.testing.assert_allclose(frame.depth[frame.body_id == 0], 4.0, rtol=1e-5)
