"""Tests camera paths in transforms.json: round trips, the axes of nerfstudio, what is refused, and damaged files."""

from __future__ import annotations

import copy
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile import VALUES, one_line

from qsim import scenes
from qsim.dataset.scene_rendering import along_path
from qsim.optics.camera import Camera
from qsim.optics.lens import Lens
from qsim.optics.zoom import Zoom
from qsim.scene import Spin, Still, Translation
from qsim.scene.camera_path import read_camera_path, write_camera_path

CAMERA = Camera(2e-3, 2.8, 3e-6, 48, 65, origin=(0.3, 1.0, 2.0))
LEVEL = [[1.0, 0, 0, 0], [0, 0, -1, -2], [0, 1, 0, 0], [0, 0, 0, 1]]  # two metres before the z axis, z up, along +y
ANGLES = {"fl_x": None, "fl_y": None, "w": 640, "h": 480}  # a view that is stated by angles alone


def written(path: Path, **changes: Any) -> Path:
    """Write a path of three level poses, one metre apart along x."""
    frames = [{"file_path": f"frame_{i}.png", "transform_matrix": copy.deepcopy(LEVEL)} for i in (9, 10, 11)]
    for i, frame in enumerate(frames):
        frame["transform_matrix"][0][3] = float(i)
    content = {"fl_x": 500.0, "fl_y": 500.0, "w": 64, "h": 48, "frame_rate": 10.0, "frames": frames} | changes
    path.write_text(json.dumps({key: value for key, value in content.items() if value is not None}))
    return path


def random_camera(rng: np.random.Generator) -> Camera:
    motion = Spin(tuple(rng.normal(size=3)), float(rng.uniform(0, 2000))) @ Translation(tuple(rng.normal(size=3) * 10))
    terms = dict(zip(("k3", "k4", "p1", "p2"), rng.uniform(0, 1e-3, 4) * rng.integers(0, 2, 4), strict=True))
    aspect = 1.0 + float(rng.uniform(-0.2, 0.2) * rng.integers(0, 2))
    lens = Lens(*rng.uniform(-0.02, 0.02, 2), shift=tuple(rng.normal(size=2) * 0.1), aspect=aspect, **terms)
    origin, target, up = (tuple(rng.normal(size=3)) for _ in range(3))
    height, width = (int(n) for n in rng.integers(1, 600, 2))
    camera = Camera(2e-3, 2.8, 3e-6, height, width, lens=lens, origin=origin, target=target, up=up, motion=motion)
    if rng.random() < 0.5:
        return camera
    views = camera.image_distance / camera.pixel_pitch / height * rng.uniform(0.9, 1.5, 7)
    lenses = [replace(lens, k1=float(k1), shift=(float(x), 0.1)) for k1, x in rng.uniform(-0.02, 0.02, (7, 2))]
    zoom = Zoom(tuple(t / 700.0 for t in range(7)), tuple(views.tolist()), tuple(lenses))
    return replace(camera, zoom=zoom, focal_length=float(views[0]) * height * 3e-6, lens=lenses[0])


def test_a_path_comes_back_to_a_billionth(tmp_path: Path):
    """Poses, view and lens of random cameras, at any angle between two poses up to half a turn."""
    rng = np.random.default_rng(0)
    for i in range(30):
        camera = random_camera(rng)
        file = tmp_path / f"{i}.json"
        again = tmp_path / f"{i}_again.json"
        write_camera_path(file, camera, frames=7, frame_rate=700.0)
        found = read_camera_path(file, camera)
        for t in range(7):
            np.testing.assert_allclose(found.pose(t / 700.0), camera.pose(t / 700.0), atol=1e-9)
        points = rng.normal(size=(20, 3)) * 5
        np.testing.assert_allclose(found.project(points, 3 / 700.0)[0], camera.project(points, 3 / 700.0)[0], rtol=1e-9)
        write_camera_path(again, found, frames=7, frame_rate=700.0)
        first, second = (json.loads(path.read_text()) for path in (file, again))
        for one, other in zip((first, *first["frames"]), (second, *second["frames"]), strict=True):
            assert one.keys() == other.keys()
            for key in one.keys() & {"w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "frame_rate"}:
                assert other[key] == pytest.approx(one[key], rel=1e-9, abs=1e-9)
        for one, other in zip(first["frames"], second["frames"], strict=True):
            assert one["file_path"] == other["file_path"]
            np.testing.assert_allclose(one["transform_matrix"], other["transform_matrix"], atol=1e-9)


def test_the_world_of_a_file_has_z_up_and_its_cameras_look_back(tmp_path: Path):
    """Poses as nerfstudio documents them: z up in the world, x right, y up and z back in the camera."""
    camera = read_camera_path(written(tmp_path / "transforms.json"))
    np.testing.assert_allclose(camera.pose(0.0)[:3, 3], (0, 0, 2), atol=1e-12)
    np.testing.assert_allclose(camera.pose(0.2)[:3, 3], (2, 0, 2), atol=1e-12)
    pixels, depth = camera.project(np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]]), 0.0)
    np.testing.assert_allclose(depth, 2)
    np.testing.assert_allclose(pixels, [(32, 24), (32 + 25, 24), (32, 24 - 25)], atol=1e-9)  # y is up here


def test_between_poses_it_moves_smoothly_and_turns_evenly(tmp_path: Path):
    frames = []
    for i, angle in enumerate((0.0, 0.6, 1.2)):
        c = math.cos(angle)
        s = math.sin(angle)
        frames.append({"transform_matrix": [[c, -s, 0, 3.0 * i], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]})
    camera = read_camera_path(written(tmp_path / "p.json", frames=frames), scale=0.5)
    for share in (0.25, 0.5, 1.75):
        pose = camera.pose(share / 10)
        turn = camera.pose(0)[:3, :3].T @ pose[:3, :3]
        assert math.acos((np.trace(turn) - 1) / 2) == pytest.approx(0.6 * share, rel=1e-9)
        assert pose[0, 3] == pytest.approx(1.5 * share, rel=1e-9)
    np.testing.assert_allclose(camera.pose(9.0), camera.pose(0.2))  # it rests at the end


def test_the_motion_of_a_path_moves_another_camera_alike(tmp_path: Path):
    motion = read_camera_path(written(tmp_path / "p.json")).motion
    moved = replace(CAMERA, motion=motion)
    np.testing.assert_allclose(moved.pose(0), CAMERA.pose(0), atol=1e-12)
    right = CAMERA.pose()[:3, 0]
    np.testing.assert_allclose(moved.pose(0.2)[:3, 3], np.asarray(CAMERA.origin) + 2 * right, atol=1e-12)


def test_what_files_of_other_programs_state_is_read(tmp_path: Path):
    """Blender states an angle and no size; frames may repeat the lens, and are numbered without zeros."""
    blender = written(tmp_path / "b.json", fl_x=None, fl_y=None, w=None, h=None, camera_angle_x=0.7)
    camera = read_camera_path(blender, CAMERA)
    assert (camera.height, camera.width) == (48, 65)
    assert camera.focal_pixels == pytest.approx(32.5 / math.tan(0.35))
    lens = {"fl_x": 300.0, "fl_y": 300.0, "w": 640.0, "h": 480.0, "cx": 330.0, "cy": 235.5, "k1": -0.02, "p1": 0.0}
    frames = json.loads(written(tmp_path / "c.json").read_text())["frames"]
    each = [frame | lens for frame in reversed(frames)]
    found = read_camera_path(written(tmp_path / "c.json", fl_x=None, fl_y=None, w=None, h=None, frames=each))
    assert found.axis == pytest.approx((330.0, 235.5))
    assert (found.lens.k1, found.height, found.width) == (-0.02, 480, 640)
    assert [found.pose(i / 10)[0, 3] for i in range(3)] == pytest.approx([0, 1, 2])  # frame_9 first
    assert read_camera_path(tmp_path / "c.json", speed=2.0).pose(0.05)[0, 3] == pytest.approx(1)
    slow = written(tmp_path / "d.json", frame_rate=None)
    assert read_camera_path(slow, frame_rate=5.0).pose(0.2)[0, 3] == pytest.approx(1)


def test_every_term_of_a_calibration_is_modelled(tmp_path: Path):
    """fl_x, fl_y, cx, cy, k1 to k4, p1 and p2 as COLMAP and nerfstudio state them, against the formula of OpenCV."""
    stated = {"fl_x": 61.0, "fl_y": 52.5, "cx": 33.7, "cy": 21.2, "k1": -0.21, "k2": 0.07, "k3": 0.012, "k4": -0.003}
    stated |= {"p1": 0.011, "p2": -0.008}
    camera = read_camera_path(written(tmp_path / "p.json", **stated, camera_model="OPENCV"))
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-0.5, 0.5, (2, 200))
    r2 = x * x + y * y
    radial = 1 + stated["k1"] * r2 + stated["k2"] * r2**2 + stated["k3"] * r2**3 + stated["k4"] * r2**4
    bent_x = x * radial + 2 * stated["p1"] * x * y + stated["p2"] * (r2 + 2 * x * x)
    bent_y = y * radial + stated["p1"] * (r2 + 2 * y * y) + 2 * stated["p2"] * x * y
    expected = np.stack([stated["fl_x"] * bent_x + stated["cx"], stated["fl_y"] * bent_y + stated["cy"]], axis=-1)
    pose = camera.pose(0.1)
    points = np.column_stack([x, y, np.ones_like(x)]) * 3.0 @ pose[:3, :3].T + pose[:3, 3]
    np.testing.assert_allclose(camera.project(points, 0.1)[0], expected, atol=1e-10)
    assert camera.pixel_area == pytest.approx(1.1e-6**2 * 52.5 / 61.0)


def test_lenses_of_every_frame_are_a_zoom(tmp_path: Path):
    """Numbers that rise evenly pass evenly between the poses, and rest before and after; the file's hold elsewhere."""
    frames = json.loads(written(tmp_path / "p.json").read_text())["frames"]
    for i, frame in enumerate(frames):
        frame |= {"fl_x": 400.0 + 80 * i, "fl_y": 500.0 + 100 * i, "cx": 30.0 + i, "k1": 0.1 * i, "p2": -0.01 * i}
    path = written(tmp_path / "p.json", frames=frames, k2=0.05, cy=20.0)
    camera = read_camera_path(path)
    x, y = np.random.default_rng(8).uniform(-0.05, 0.05, (2, 50))
    r2 = x * x + y * y
    for t, at in ((0.0, 0.0), (0.05, 0.5), (0.13, 1.3), (0.2, 2.0), (0.9, 2.0), (-1.0, 0.0)):
        bent = 1 + 0.1 * at * r2 + 0.05 * r2 * r2
        across = x * bent - 0.01 * at * (r2 + 2 * x * x)
        down = y * bent - 2 * 0.01 * at * x * y
        expected = np.stack([(400 + 80 * at) * across + 30 + at, (500 + 100 * at) * down + 20], axis=-1)
        pose = camera.pose(t)
        points = np.column_stack([x, y, np.ones_like(x)]) @ pose[:3, :3].T + pose[:3, 3]
        np.testing.assert_allclose(camera.project(points, t)[0], expected, atol=1e-9)
    moved = camera.resized(24, 32).at(0.1)
    assert (moved.focal_pixels, moved.axis) == (pytest.approx(300.0), pytest.approx((15.5, 10.0)))
    near = read_camera_path(path, replace(CAMERA, aperture_blur=True, focus_distance=0.05))
    assert near.at(0.1).focal_pixels == pytest.approx(600.0)
    assert near.at(0.1).focus == 0.05


def test_focal_lengths_of_two_angles_are_modelled(tmp_path: Path):
    camera = read_camera_path(written(tmp_path / "a.json", **ANGLES, camera_angle_x=0.8, camera_angle_y=0.8))
    assert camera.focal_pixels == pytest.approx(240 / math.tan(0.4))
    assert camera.focal_pixels * camera.aspect == pytest.approx(320 / math.tan(0.4))


def test_rounded_angles_of_square_pixels_are_read(tmp_path: Path):
    """The vertical angle was not read; without a size it belongs to pictures of another shape, and is not compared."""
    angles = {"camera_angle_x": 0.8, "camera_angle_y": round(2 * math.atan(0.75 * math.tan(0.4)), 3)}
    camera = read_camera_path(written(tmp_path / "a.json", **ANGLES, **angles))
    assert camera.focal_pixels == pytest.approx(320 / math.tan(0.4))
    unsized = read_camera_path(written(tmp_path / "b.json", **ANGLES | {"w": None, "h": None}, **angles), CAMERA)
    assert unsized.focal_pixels == pytest.approx(32.5 / math.tan(0.4))


def test_a_thin_lens_keeps_its_focus_and_gets_the_view(tmp_path: Path):
    like = replace(CAMERA, aperture_blur=True, focus_distance=0.05, f_number=1.4, lens=Lens(falloff=(-0.2,)))
    camera = read_camera_path(written(tmp_path / "p.json", k1=0.01), like)
    assert camera.focal_pixels == pytest.approx(500, rel=1e-12)
    assert (camera.focus, camera.f_number, camera.lens) == (0.05, 1.4, Lens(0.01, 0.0, (-0.2,)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": []}, "needs two or more frames, found 0"),
        ({"frames": [{"transform_matrix": LEVEL}]}, "needs two or more frames, found 1"),
        ({"frames": [{"transform_matrix": [[2.0, 0, 0, 0], *LEVEL[1:]]}] * 2}, "frame 0: transform_matrix is no rotat"),
        ({"frames": [{"transform_matrix": [[-1.0, 0, 0, 0], *LEVEL[1:]]}] * 2}, "right-handed"),
        ({"frames": [{"transform_matrix": [*LEVEL[:3], [0, 0, 1, 1]]}] * 2}, "no rotation with a position"),
        ({"frames": [{"transform_matrix": LEVEL[:2]}] * 2}, "transform_matrix: expected a list of 3 to 4"),
        (
            {"frames": [{"transform_matrix": LEVEL, "w": 5 + i} for i in (0, 1)]},
            "frames differ in w .a path has one se",
        ),
        (
            {"frames": [{"transform_matrix": LEVEL, "k1": -i, "k6": i, "is_fisheye": bool(i)} for i in (0, 1)]},
            "frames differ in k6, is_fisheye .a path has one sensor and one model.: split the file by cameras",
        ),
        (
            {"frames": [{"transform_matrix": LEVEL, "k1": -300.0 * i} for i in (0, 1)]},
            "frame 1: Camera.lens: with k1 = -300 the picture folds",
        ),
        ({"camera_model": "OPENCV_FISHEYE"}, "camera_model is 'OPENCV_FISHEYE' .read are OPENCV, "),
        ({"camera_model": "ORTHOPHOTO"}, "camera_model is 'ORTHOPHOTO'"),
        ({"is_fisheye": True}, "is_fisheye is true"),
        ({"k5": 1e-3}, "k5 is 0.001 .modelled are k1, k2, .*p2.: calibrate with COLMAP's model OPENCV"),
        (
            {"k6": 0.1, "skew": 0.2, "fl_y": 501.0, "is_fisheye": True, "camera_model": "THIN_PRISM"},
            "camera_model is 'THIN_PRISM' .*; is_fisheye is true .*; k6 is 0.1 .*; skew is 0.2 ",
        ),
        ({"fl_y": 1.0}, "Lens.aspect, fl_x over fl_y, must be in .0.1, 10., got 500"),
        ({"p1": 2.0}, "with p1 = 2 the picture folds at 0.04"),
        ({"fl_x": None}, "states neither fl_x nor camera_angle_x"),
        ({"w": None}, "states no w and h"),
        ({"frame_rate": None}, "states no frame_rate"),
        ({"k1": -99.0, "fl_x": 50.0, "fl_y": 50.0}, "the picture folds"),
        ({"fl_x": 1e9, "fl_y": 1e9}, "focal_length is in metres"),
        ({"camera_angle_x": 4.0}, "camera_angle_x: expected a number from 1e-06 to 3.14"),
    ],
)
def test_paths_that_are_not_modelled_are_refused(tmp_path: Path, changes: dict[str, Any], message: str):
    path = written(tmp_path / "transforms.json", **changes)
    with pytest.raises(ValueError, match=message) as caught:
        read_camera_path(path)
    one_line(caught.value, path)


def test_mutated_files_are_refused_in_one_line_or_give_finite_poses(tmp_path: Path):
    """Every value of a file is replaced by wrong ones of every kind, and the text is cut everywhere."""
    whole = written(tmp_path / "p.json", cx=30.0, cy=20.0, k1=0.1, k2=0.0, camera_model="OPENCV", camera_angle_x=0.5)
    content = json.loads(whole.read_text())
    places = [(key,) for key in content] + [("frames", 0), ("frames", 1, "file_path"), ("frames", 1, "fl_x")]
    places += [("frames", 2, "transform_matrix", *more) for more in ((), (0,), (1, 2), (3, 3))]
    path = tmp_path / "q.json"
    read = 0
    texts = [whole.read_text()[:cut] for cut in range(0, len(whole.read_text()), 37)] + [
        "[]",
        "null",
        '{"a": "\\ud800"}',
    ]
    for place in places:
        for value in VALUES:
            damaged = copy.deepcopy(content)
            inner = damaged
            for step in place[:-1]:
                inner = inner[step]
            inner[place[-1]] = value
            texts.append(json.dumps(damaged))
    for text in texts:
        path.write_text(text)
        try:
            camera = read_camera_path(path)
        except ValueError as error:
            one_line(error, path)
        else:
            read += 1
            assert np.isfinite([camera.pose(t) for t in (0.0, 0.1, 7.0)]).all()
    assert 0 < read < len(texts) / 3


def test_paths_are_written_whole_or_not_at_all(tmp_path: Path):
    file = tmp_path / "transforms.json"
    for wrong in ({"frames": 1, "frame_rate": 10.0}, {"frames": 3, "frame_rate": 0.0}):
        with pytest.raises(ValueError, match="two or more frames at a rate above 0"):
            write_camera_path(file, CAMERA, **wrong)
    assert list(tmp_path.iterdir()) == []
    write_camera_path(file, CAMERA, frames=2, frame_rate=10.0)
    with pytest.raises(FileExistsError, match="exists"):
        write_camera_path(file, replace(CAMERA, motion=Still()), frames=3, frame_rate=10.0)
    write_camera_path(file, CAMERA, frames=3, frame_rate=10.0, force=True)
    assert len(json.loads(file.read_text())["frames"]) == 3
    with pytest.raises(FileNotFoundError):
        read_camera_path(tmp_path / "none.json")
    for wrong in ({"scale": 0.0}, {"speed": math.nan}):
        with pytest.raises(ValueError, match="must be a number above 0"):
            read_camera_path(file, **wrong)


@pytest.mark.parametrize("size", [(128, 128), (48, 200)])
def test_an_angle_without_a_size_is_that_of_the_rendered_picture(tmp_path: Path, size):
    """It was that of the family's 512 x 1024 px, whose height was then kept: 39.6 degrees became 20.4."""
    file = written(tmp_path / "b.json", fl_x=None, fl_y=None, w=None, h=None, camera_angle_x=0.6911)
    scene = scenes.load("room")
    found = along_path(scene, file, 2000.0, size).resized(*size).camera
    assert (found.height, found.width) == size
    assert 2 * math.atan(size[1] / 2 / found.focal_pixels) == pytest.approx(0.6911)
    stated = written(tmp_path / "c.json", fl_x=None, fl_y=None, w=2 * size[1], h=2 * size[0], camera_angle_x=0.6911)
    same = along_path(scene, stated, 2000.0, size).resized(*size).camera
    assert same.focal_pixels == pytest.approx(found.focal_pixels)
    with pytest.raises(ValueError, match="fl_x is in pixels, and w and h are missing"):
        along_path(scene, written(tmp_path / "d.json", w=None, h=None), 2000.0, size)


def test_decimals_in_the_names_of_pictures_are_numbers(tmp_path):
    """Poses at 27.0, 27.05, 27.1 ... came as 0, 2, 4, 6, 8, 1, 3, 5, 7."""
    path = written(tmp_path / "transforms.json")
    content = json.loads(path.read_text())
    frame = content["frames"][0]
    content["frames"] = [copy.deepcopy(frame) | {"file_path": f"images/{27 + 0.05 * t:g}.png"} for t in range(9)]
    for t, each in enumerate(content["frames"]):
        each["transform_matrix"][0][3] = float(t)
    path.write_text(json.dumps(content | {"frames": content["frames"][::-1]}))
    read = read_camera_path(path)
    np.testing.assert_allclose([read.pose(t / 10)[0, 3] for t in range(9)], range(9), atol=1e-9)
