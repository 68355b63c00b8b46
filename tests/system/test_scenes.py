"""The scene library: families build, repeat with their seed, vary between seeds, and move as fast as documented.

Motion is measured by projecting points of the bodies, without rendering. The quick tier builds one seed of every
family; slow tests check the same laws for other seeds and speeds.
"""

from __future__ import annotations

import functools

import numpy as np
import pytest

from qsim import scenes
from qsim.optics.camera import Camera
from qsim.rendering.budget import Budget
from qsim.rendering.renderer import Renderer
from qsim.scene import AreaLamp, Body, Constant, EnvironmentImage, Keyframes, PointLight, Scene, SunSky, Translation
from qsim.scene.shapes import sheet
from qsim.scenes import macro
from qsim.scenes.common import FRAME_RATE, HEIGHT, WIDTH

SEEDS = (0, 1, 2)
EVERY_SEED = [
    pytest.param(family, seed, marks=() if seed == 0 else pytest.mark.slow, id=f"{family}-{seed}")
    for family in scenes.FAMILIES
    for seed in SEEDS
]
QUICK = ("fan", "flag", "room", "tumble")  # a spin, a deformation, a moving camera, many flights
SOME_FAMILIES = [
    pytest.param(family, marks=() if family in QUICK else pytest.mark.slow, id=family) for family in scenes.FAMILIES
]
MOVES = 0.05  # px/frame; slower points count as still
LARGEST_RADIANCE = 1e3  # of lamps and pictures, W m^-2 sr^-1


@functools.cache
def built(family: str, seed: int = 0, speed: float = 1.0) -> Scene:
    return scenes.load(family, seed, speed)


@functools.cache
def described(family: str, seed: int) -> dict:
    return built(family, seed).to_dict()


def vertices_in_world(body: Body, t: float) -> np.ndarray:
    pose = body.pose(t)
    return body.vertices(t) @ pose[:3, :3].T + pose[:3, 3]


def points_on(body: Body, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, float]:
    """Return faces [N] and barycentric weights [N, 3] of random points on a body at time 0, and the area [m^2]."""
    corner = body.vertices(0.0)[body.mesh.faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1) / 2
    faces = rng.choice(len(area), count, p=area / area.sum())
    return faces, rng.dirichlet((1, 1, 1), count), float(area.sum())


def image_motion(scene: Scene, times: tuple[float, ...] = (0.002, 0.008), count: int = 800) -> float:
    """Return the mean motion [px/frame] of moving points in view, weighted by image area; occlusion is ignored."""
    rng = np.random.default_rng(9)
    camera = scene.camera
    speeds = []
    weights = []
    for body in scene.bodies:
        faces, share, surface = points_on(body, count, rng)
        for t in times:
            pixels = []
            z = []
            for instant in (t, t + 1 / FRAME_RATE):
                corner = vertices_in_world(body, instant)[body.mesh.faces[faces]]
                p, depth = camera.project(np.einsum("nk,nki->ni", share, corner), instant)
                pixels.append(p)
                z.append(depth)
            corner = vertices_in_world(body, t)[body.mesh.faces[faces]]
            normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
            normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
            towards = np.einsum("nk,nki->ni", share, corner) - camera.pose(t)[:3, 3]
            distance = np.linalg.norm(towards, axis=1)
            weight = surface / count * np.abs(np.einsum("ni,ni->n", normal, towards)) / distance**3
            inside = ((pixels[0] > 0) & (pixels[0] < (camera.width, camera.height))).all(axis=1) & (z[0] > 0)
            speed = np.linalg.norm(pixels[1] - pixels[0], axis=1)
            moving = inside & (speed > MOVES)
            speeds.append(speed[moving])
            weights.append(weight[moving])
    if not sum(map(len, speeds)):
        return 0.0
    return float(np.average(np.concatenate(speeds), weights=np.concatenate(weights)))


def test_the_measure_of_motion_agrees_with_a_translating_plate():
    camera = Camera(focal_length=8e-3, f_number=2.8, pixel_pitch=1e-5, height=HEIGHT, width=WIDTH, origin=(0, 0, 4))
    plate = Body("plate", sheet(0.5, 0.5), motion=Translation((20.0, 0.0, 0.0)))
    wall = Body("wall", sheet(9, 9))
    expected = 8e-3 / 1e-5 * 20.0 / FRAME_RATE / 4  # focal length [px] times angle
    assert image_motion(Scene("plate", 0, camera, (Constant(1.0),), (wall, plate))) == pytest.approx(expected)


def test_there_are_at_least_twelve_families():
    assert len(scenes.FAMILIES) >= 12


@pytest.mark.parametrize(("family", "seed"), EVERY_SEED)
def test_a_family_builds_sound_scenes(family, seed):
    scene = built(family, seed)
    assert (scene.name, scene.seed, scene.speed) == (family, seed, 1.0)
    assert (scene.camera.height, scene.camera.width) == (HEIGHT, WIDTH)
    assert scene.lights
    assert scene.emits()
    assert sum(len(body.mesh.faces) for body in scene.bodies) < 250_000
    for body in scene.bodies:
        for t in (0.0, 0.016):
            assert np.isfinite(vertices_in_world(body, t)).all(), body.name
        assert np.linalg.norm(np.ptp(body.mesh.vertices, axis=0)) > 1e-3, "smaller than a millimetre"
    for light in scene.lights:
        match light:
            case AreaLamp(radiance=radiance) | Constant(radiance):
                assert 0 < radiance < LARGEST_RADIANCE
            case EnvironmentImage(image, scale):
                assert 0 <= np.min(image) * scale < np.max(image) * scale < LARGEST_RADIANCE
            case PointLight(intensity=intensity):
                assert intensity > 0


@pytest.mark.parametrize("family", SOME_FAMILIES)
def test_the_same_seed_gives_the_same_things_at_any_speed(family):
    again = built(family, 0, 2.0).to_dict()
    assert {k: v for k, v in again["camera"].items() if k != "motion"} == {
        k: v for k, v in described(family, 0)["camera"].items() if k != "motion"
    }
    for body, other in zip(described(family, 0)["bodies"], again["bodies"], strict=True):
        for key in ("name", "mesh", "material"):
            assert body[key] == other[key], body["name"]


@pytest.mark.parametrize("family", SOME_FAMILIES)
def test_other_seeds_differ_in_layout_and_texture_and_light(family):
    descriptions = [described(family, seed) for seed in SEEDS]
    for i, one in enumerate(descriptions):
        for other in descriptions[i + 1 :]:
            assert one["lights"] != other["lights"]
            assert one["camera"] != other["camera"]
            motions, others = ([v["camera"]["motion"], *(b["motion"] for b in v["bodies"])] for v in (one, other))
            assert motions != others
            assert [b["material"] for b in one["bodies"]] != [b["material"] for b in other["bodies"]]


@pytest.mark.parametrize("family", SOME_FAMILIES)
def test_twice_the_speed_moves_as_far_in_half_the_time(family):
    """Steps from time 0 in body coordinates; gravity does not scale and moves 5 um in a frame."""
    once = built(family, 0)
    twice = built(family, 0, 2.0)
    step = 1 / FRAME_RATE
    moving = 0

    def same(slow, fast, still):
        a, b = (np.linalg.inv(m(0.0)) @ m(t) for m, t in ((slow, step), (fast, step / 2)))
        np.testing.assert_allclose(a, b, atol=1e-5)
        return int(np.abs(a - still).max() > 1e-5)

    for body, faster in zip(once.bodies, twice.bodies, strict=True):
        moving += same(body.pose, faster.pose, np.eye(4))
        if body.deforms:
            np.testing.assert_allclose(body.vertices(step), faster.vertices(step / 2), atol=1e-9)
            moving += int(np.abs(body.vertices(step) - body.vertices(0.0)).max() > 1e-5)
    moving += same(once.camera.pose, twice.camera.pose, np.eye(4))
    for light, faster in zip(once.lights, twice.lights, strict=True):
        motion = getattr(light, "motion", None)
        if motion is not None:
            moving += same(motion.pose, faster.motion.pose, np.eye(4))
    assert moving > 0, "nothing moves"


@pytest.mark.parametrize(("family", "seed"), EVERY_SEED)
def test_motion_at_speed_one_is_some_pixels_per_frame(family, seed):
    assert 0.8 < image_motion(built(family, seed)) < 8


def test_the_camera_of_a_close_up_never_rests():
    """At 40 times the speed its path of twelve poses lasts 22 frames: it goes back and forth, without a jump."""
    camera = built("macro", 0, 40.0).camera
    places = np.array([camera.pose(t / FRAME_RATE)[:3, 3] for t in range(200)])
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).min() > 1e-3  # m
    motion = camera.motion
    step = macro.STEP / 40
    for turn in (11, 22, 23, 44, 45):
        before, after = (motion.velocity((turn + side) * step)[0] for side in (-1e-6, 1e-6))
        np.testing.assert_allclose(before, after, atol=0.01)  # m/s, of 20 to 50
    np.testing.assert_allclose(motion.pose(7.3 * step), motion.pose((7.3 + 66) * step), atol=1e-9)
    path = motion.path
    earlier = Keyframes(*(values[: macro.KEYS] for values in (path.times, path.positions, path.turns)))
    for t in np.linspace(-step, 10 * step, 50):
        np.testing.assert_array_equal(motion.pose(t), earlier.pose(t))


def test_loading_by_name_and_by_file(tmp_path):
    assert scenes.load("fan", 1, 2.0).speed == 2.0
    own = tmp_path / "own.py"
    own.write_text("from qsim.scenes.fan import scene\n")
    assert scenes.load(own, 3).to_dict() == scenes.load("fan", 3).to_dict()
    with pytest.raises(
        ValueError,
        match=r"no scene family 'fun'.*; there are .*fan.*or give a .py, .glb, .gltf or .xml file or a folder",
    ):
        scenes.load("fun")
    with pytest.raises(ValueError, match=r"scene '': name a family, a file or a folder; '\.' is the present folder"):
        scenes.load("")
    with pytest.raises(ValueError, match=r"speed: expected a number from 0\.001 to 1000, got 1000\.1"):
        scenes.load("fan", speed=1000.1)
    with pytest.raises(FileNotFoundError, match=r"missing.py: no such file"):
        scenes.load(tmp_path / "missing.py")
    own.write_text("x = 1\n")
    with pytest.raises(ValueError, match=r"needs a function scene\(seed=0"):
        scenes.load(own)


def test_a_folder_of_meshes_textures_and_environments_becomes_scenes(tmp_path):
    """The files of the folder are used, differently for other seeds; missing kinds are made."""
    import OpenEXR
    from PIL import Image

    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "peak.off").write_text(
        "OFF\n4 4 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n"
    )
    Image.fromarray(np.tile(np.arange(16, dtype=np.uint8) * 15, (9, 1))).save(tmp_path / "ramp.png")
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": np.full((8, 16, 3), 0.5, np.float32)}).write(str(tmp_path / "sky.exr"))
    first, other = (scenes.load(tmp_path, seed) for seed in (0, 1))
    assert first.to_dict() == scenes.load(tmp_path, 0).to_dict()
    assert first.to_dict() != other.to_dict()
    moving = [body for body in first.bodies if body.motion is not None]
    assert len(moving) >= 4
    assert all(len(body.mesh.faces) == 4 for body in moving)
    assert isinstance(first.lights[0], EnvironmentImage)
    for body in first.bodies:
        assert body.material.reflectance.pixels().shape == (9, 16)
    frame = Renderer(first.resized(16, 20), budget=Budget(8, 2)).frame(8)
    assert frame.radiance.min() > 0
    assert np.nanmax(np.hypot(*frame.flow)) > 0
    (tmp_path / "sky.exr").unlink()
    assert isinstance(scenes.load(tmp_path).lights[0], SunSky)
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match="empty: no mesh, picture or environment in this folder"):
        scenes.load(tmp_path / "empty")


@pytest.mark.slow
@pytest.mark.parametrize("family", scenes.FAMILIES)
def test_a_family_renders_light_everywhere_and_true_motion(family):
    frame = Renderer(built(family, 0).resized(32, 64), frame_rate=FRAME_RATE, budget=Budget(samples=16)).frame(8)
    assert frame.radiance.min() > 0
    assert frame.radiance.max() > 1.5 * frame.radiance.min()
    assert np.nanmax(np.hypot(*frame.flow)) * HEIGHT / 32 > 0.7


def test_a_speed_acts_late_or_along_a_path(tmp_path):
    """A scene whose motion begins after 25 ms was refused, and so was the speed of a camera around a scene at rest."""
    own = tmp_path / "late.py"
    own.write_text(
        "from dataclasses import replace\nfrom qsim import scenes\nfrom qsim.scene import Keyframes\n\n\n"
        "def scene(seed=0, *, speed=1.0):\n"
        "    plain = scenes.load('plain')\n"
        "    moved = Keyframes((0.05 / speed, 0.1 / speed), ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)))\n"
        "    rest = [replace(body, motion=None) for body in plain.bodies[1:]]\n"
        "    return replace(plain, bodies=(replace(plain.bodies[0], motion=moved), *rest))\n"
    )
    scenes.load(own, speed=2.0)
    own.write_text(own.read_text().replace(" / speed", ""))
    with pytest.raises(ValueError, match="moves at speed 2 as at 1"):
        scenes.load(own, speed=2.0)
    scenes.load(own, speed=2.0, along_path=True)
