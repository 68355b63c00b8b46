"""Scenes in Mitsuba's XML: our camera gives the same picture as Mitsuba's, and named shapes move with true flow."""

from __future__ import annotations

import os

import numpy as np
import pytest
from small_scenes import CAMERA, RATE

from qsim import scenes
from qsim.rendering.budget import Budget
from qsim.rendering.clip_rendering import render_clip
from qsim.rendering.mitsuba_xml import read_mitsuba
from qsim.rendering.renderer import Renderer
from qsim.scene import Body, Flag, Mains, Mesh, PulseWidth, Scene, Spin, Still, Translation

SENSOR = """<sensor type="perspective"><float name="fov" value="40"/><string name="fov_axis" value="y"/>
  <transform name="to_world"><lookat origin="0,0.5,4" target="0,0,0" up="0,1,0"/></transform>
  <film type="hdrfilm"><integer name="width" value="33"/><integer name="height" value="24"/>
  <rfilter type="box"/></film></sensor>"""
LIGHT = '<emitter type="constant"><rgb name="radiance" value="0.7"/></emitter>'
SHAPES = """<bsdf type="diffuse" id="grey"><rgb name="reflectance" value="0.4"/></bsdf>
<shape type="sphere" id="ball"><float name="radius" value="0.5"/><point name="center" x="0.7" y="0" z="0"/></shape>
<shape type="cube" id="box"><transform name="to_world"><scale value="0.4"/><translate x="-0.7"/></transform></shape>
<shape type="rectangle"><transform name="to_world"><scale value="6"/><translate z="-2"/></transform>
<ref id="grey"/></shape>"""
BUDGET = Budget(samples=32, bounces=3)


def written(folder, *parts: str):
    path = folder / "room.xml"
    path.write_text(f'<scene version="3.0.0">{"".join(parts)}</scene>')
    return path


@pytest.fixture
def room(tmp_path):
    return written(tmp_path, SENSOR, LIGHT, SHAPES)


def test_named_shapes_move_with_their_true_flow(room):
    """A mesh and a sphere translate: flow is focal length times the change of x/z, on each hit point."""
    step = np.array([0.05, 0.0, 0.0])
    motion = Translation(tuple(step * RATE))
    scene = read_mitsuba(room, {"ball": motion, "box": motion})
    views = Renderer(scene, frame_rate=RATE, budget=BUDGET)
    first = views.frame(0)
    second = views.frame(1)
    assert [part.name for part in scene.parts] == ["ball", "box", "shape 2"]
    assert sorted(np.unique(first.body_id)) == [0, 1, 2]
    expected = scene.camera.focal_pixels * step[0] / first.depth  # a step along x does not change z
    for number in (0, 1):
        on = first.body_id == number
        assert on.sum() > 10
        assert np.abs(first.flow[0][on] - expected[on]).max() < 0.02
        assert np.abs(first.flow[1][on]).max() < 0.02
        assert np.nonzero(second.body_id == number)[1].mean() > np.nonzero(on)[1].mean() + 0.2
    assert (first.flow[:, first.body_id == 2] == 0).all()
    assert (views.frame(0).radiance == first.radiance).all(), "going back gives the same frame"


def test_a_spinning_mesh_turns_its_normals_too(room):
    """A box turned by a right angle about its own middle looks the same, in place and in light."""
    quarter = Spin((0, 1, 0), np.pi / 2 * RATE, center=(-0.7, 0.0, 0.0))
    views = Renderer(read_mitsuba(room, {"box": quarter}), frame_rate=RATE, budget=Budget(128, 3))
    first = views.frame(0)
    turned = views.frame(1)
    assert (first.body_id == turned.body_id).mean() > 0.99
    on = (first.body_id == 1) & (turned.body_id == 1)
    assert np.abs(first.radiance[on].mean() / turned.radiance[on].mean() - 1) < 0.02
    assert np.hypot(*first.flow)[on].max() > 0.5


def test_our_camera_gives_the_picture_of_the_files_camera(room):
    from qsim.rendering import engine

    engine.select()
    import mitsuba as mi

    scene = read_mitsuba(room)
    ours = Renderer(scene, budget=Budget(512, 3)).frame(0)
    mi.set_log_level(mi.LogLevel.Error)
    try:
        theirs = np.array(
            mi.render(mi.load_file(str(room)), integrator=mi.load_dict({"type": "path", "max_depth": 4}), spp=512)
        )[..., 0]
    finally:
        mi.set_log_level(mi.LogLevel.Warn)
    assert theirs.shape == ours.radiance.shape == (24, 33)
    assert np.sqrt(np.mean((theirs - ours.radiance) ** 2)) < 0.03 * ours.radiance.mean()


def test_a_clip_names_its_file_and_rendering_by_name_works(room, tmp_path):
    scene = scenes.load(room)
    clip = render_clip(scene, tmp_path / "clip", frames=1, budget=Budget(2, 1))
    assert clip.info.scene.family == "room"
    assert len(scene.to_dict()["file"]["sha256"]) == 64
    assert scene.resized(48, 66).camera.height == 48


LENS = SENSOR.replace('type="perspective">', 'type="thinlens"><float name="aperture_radius" value="0.1"/>')
MEDIUM = """<shape type="sphere" id="fog"><bsdf type="null"/>
<medium name="interior" type="homogeneous"><float name="albedo" value="0.5"/></medium></shape>"""


@pytest.mark.parametrize(
    ("parts", "motions", "message"),
    [
        ((SENSOR, LIGHT, SHAPES), {"bal": Still()}, r"room.xml: no shape has the id 'bal' \(did you mean 'ball'\?\)"),
        ((SENSOR, LIGHT, SHAPES), {"xyz": Still()}, r"no shape has the id 'xyz'; there are 'ball', 'box', 'shape 2'"),
        ((SENSOR, SHAPES), {}, "no emitter, every pixel would be black"),
        ((LIGHT, SHAPES), {}, "no sensor; give a camera of your own"),
        ((LENS, LIGHT, SHAPES), {}, "ThinLensCamera, only 'perspective' is taken over"),
        ((SENSOR.replace("<lookat", '<scale x="-1"/><lookat'), LIGHT), {}, "mirrors the picture"),
        ((SENSOR, LIGHT, MEDIUM), {}, "'fog' holds a participating medium"),
        ((SENSOR, '<emitter type="sunsky"/>'), {}, "Mitsuba cannot load it: .*sunsky"),
        ((SENSOR, "<emitter"), {}, "Mitsuba cannot load it: .*XML"),
        ((SENSOR, LIGHT, SHAPES), {"box": Flag(np.eye(3), ())}, "shape box: shapes of a Mitsuba file move rigidly"),
    ],
)
def test_unsupported_files_and_motions_are_refused(tmp_path, parts, motions, message):
    with pytest.raises(ValueError, match=message):
        read_mitsuba(written(tmp_path, *parts), motions)


def test_a_pipe_that_a_file_names_is_refused(tmp_path):
    """Mitsuba waits for it; also in a file that is included, and in a folder that is searched."""
    (tmp_path / "deep").mkdir()
    os.mkfifo(tmp_path / "deep/pipe")
    mesh = '<path value="deep"/><shape type="ply"><string name="filename" value="pipe"/></shape>'
    (tmp_path / "inner.xml").write_text(f'<scene version="3.0.0">{mesh}</scene>')
    (tmp_path / "outer.xml").write_text('<scene version="3.0.0"><include filename="inner.xml"/></scene>')
    for name in ("inner.xml", "outer.xml"):
        with pytest.raises(ValueError, match=r"pipe: is a folder, a pipe or a device"):
            read_mitsuba(tmp_path / name)


def test_a_missing_file_and_a_mixture_are_refused(tmp_path, room):
    with pytest.raises(FileNotFoundError, match=r"nothing.xml: no such file"):
        read_mitsuba(tmp_path / "nothing.xml")
    read = read_mitsuba(room, camera=CAMERA)
    assert read.camera is CAMERA
    with pytest.raises(ValueError, match="either records or those of a Mitsuba file"):
        Scene("mix", 0, CAMERA, (), (Body("a", Mesh(np.eye(3), np.array([[0, 1, 2]]))),), file=read.file)


LIGHTS = {
    "bulb": """<emitter type="point" id="bulb"><rgb name="intensity" value="4"/>
        <point name="position" x="0" y="1" z="3"/></emitter>""",
    "sun": '<emitter type="directional" id="sun"><rgb name="irradiance" value="1"/></emitter>',
    "sky": '<emitter type="constant" id="sky"><rgb name="radiance" value="0.2"/></emitter>',
    "lamp": """<shape type="sphere" id="lamp"><point name="center" x="0" y="1" z="1"/><float name="radius" value="0.2"/>
        <emitter type="area" id="glow"><rgb name="radiance" value="9"/></emitter></shape>""",
}


@pytest.mark.parametrize("name", LIGHTS)
def test_lights_of_a_file_flicker(tmp_path, name):
    """One light alone: every frame is that of the steady light times the exact mean strength of its exposure."""
    path = written(tmp_path, SENSOR, LIGHTS[name], SHAPES)
    flicker = PulseWidth(400.0, duty=0.3)
    budget = Budget(samples=4, bounces=2)
    found = Renderer(read_mitsuba(path, flickers={name: flicker}), frame_rate=RATE, budget=budget)
    steady = Renderer(read_mitsuba(path), frame_rate=RATE, budget=budget)
    strengths = found.strengths(4)[name]
    assert np.ptp(strengths) > 1
    for t, strength in enumerate(strengths):
        expected = strength * steady.frame(t).radiance
        np.testing.assert_allclose(found.frame(t).radiance, expected, rtol=2e-5, atol=1e-7)


def test_a_clip_states_the_flicker_of_a_file(tmp_path):
    path = written(tmp_path, SENSOR, LIGHTS["bulb"], LIGHTS["sky"], SHAPES)
    scene = read_mitsuba(path, flickers={"bulb": Mains(100.0)})
    clip = render_clip(scene, tmp_path / "clip", frames=3, frame_rate=RATE, budget=BUDGET)
    assert set(clip.strengths) == {"bulb"}
    assert clip.info.flicker["bulb"].frequency == 100.0
    assert scene.to_dict()["file"]["flickers"]["bulb"]["kind"] == "Mains"
    assert "flickers" not in read_mitsuba(path).to_dict()["file"]


@pytest.mark.parametrize(
    ("flickers", "message"),
    [
        ({"bulbb": Mains(100.0)}, r"no light whose strength is one number has the id 'bulbb' \(did you mean 'bulb'"),
        ({"box": Mains(100.0)}, "has the id 'box'; there are 'bulb', 'lamp'$"),
        ({"glow": Mains(100.0)}, "has the id 'glow'"),
        ({"bulb": 100.0}, "flicker of 'bulb': Mains, RectifiedSine or PulseWidth is expected, got 100.0"),
    ],
)
def test_flickers_of_no_light_are_refused(tmp_path, flickers, message):
    path = written(tmp_path, SENSOR, LIGHTS["bulb"], LIGHTS["lamp"], SHAPES)
    with pytest.raises(ValueError, match=message):
        read_mitsuba(path, flickers=flickers)


def test_a_shape_called_sun_has_its_own_truth(tmp_path):
    """Its flow, depth and body were those of the sky."""
    ball = '<shape type="sphere" id="sun"><float name="radius" value="0.9"/></shape>'
    views = Renderer(read_mitsuba(written(tmp_path, SENSOR, LIGHT, ball)), frame_rate=RATE, budget=BUDGET)
    frame = views.frame(0)
    assert sorted(np.unique(frame.body_id)) == [-1, 0]
    assert np.isfinite(frame.depth[frame.body_id == 0]).all()


def test_holes_by_opacity_are_told(tmp_path):
    """Light passes them, and the truth there is that of the whole shape."""
    card = '<shape type="rectangle" id="leaf"><bsdf type="mask"><float name="opacity" value="0.5"/>{}</bsdf></shape>'
    pane = '<shape type="rectangle" id="pane"><bsdf type="thindielectric"/></shape>'
    with pytest.warns(UserWarning, match="shape 'leaf' has holes by its opacity") as caught:
        read_mitsuba(written(tmp_path, SENSOR, LIGHT, card.format('<bsdf type="diffuse"/>'), pane))
    assert len(caught) == 1
