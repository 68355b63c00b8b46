"""Cameras of Mitsuba files: what the file's own film shows, or a refusal that names the setting."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest

from qsim.dataset.scene_rendering import load_scene
from qsim.rendering.budget import Budget
from qsim.rendering.mitsuba_xml import read_mitsuba
from qsim.rendering.render_settings import RenderSettings
from qsim.rendering.renderer import Renderer

SCENE = """<scene version="3.0.0"><integrator type="path"/>
<sensor type="perspective">{camera}
<transform name="to_world"><lookat origin="0.4,0.9,4" target="0,0,0" up="0.1,1,0"/></transform>
<film type="hdrfilm"><integer name="width" value="36"/><integer name="height" value="28"/>{film}<rfilter type="box"/>
</film></sensor>
{light}
<shape type="rectangle" id="floor"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="3"/>
<translate y="-0.5"/></transform></shape>
<shape type="sphere" id="ball"><float name="radius" value="0.5"/><bsdf type="diffuse">
<spectrum name="reflectance" value="0.1"/></bsdf></shape>
<shape type="cube" id="box"><transform name="to_world"><scale value="0.2"/><translate x="1" y="0.3"/></transform>
<bsdf type="diffuse"><spectrum name="reflectance" value="0.9"/></bsdf></shape></scene>"""
EVEN = '<emitter type="constant"><spectrum name="radiance" value="1"/></emitter>'


def write(folder: Path, camera: str = "", film: str = "", light: str = EVEN) -> Path:
    path = folder / "scene.xml"
    path.write_text(SCENE.format(camera=camera, film=film, light=light))
    return path


def number(name: str, value: object) -> str:
    return f'<float name="{name}" value="{value}"/>'


def whole(name: str, value: object) -> str:
    return f'<integer name="{name}" value="{value}"/>'


def test_frames_show_what_the_files_own_film_shows(tmp_path):
    """Random fields of view, axes, crop windows and principal points: as Mitsuba's own render, to the noise of both."""
    import mitsuba as mi

    rng = np.random.default_rng(5)
    for axis in ("x", "diagonal"):
        camera = number("fov", rng.uniform(25, 60)) + f'<string name="fov_axis" value="{axis}"/>'
        camera += number("principal_point_offset_x", rng.uniform(-0.2, 0.2))
        camera += number("principal_point_offset_y", rng.uniform(-0.2, 0.2))
        left, top = (int(n) for n in rng.integers(0, 12, 2))
        film = whole("crop_offset_x", left) + whole("crop_offset_y", top)
        film += whole("crop_width", 36 - left - 3) + whole("crop_height", 28 - top - 1)
        path = write(tmp_path, camera, film)
        scene = read_mitsuba(path)
        ours = Renderer(scene, budget=Budget(256, 8)).frame(0, with_truth=False).radiance
        theirs = np.array(mi.render(mi.load_file(str(path)), spp=256))[..., 0]
        assert ours.shape == theirs.shape == (28 - top - 1, 36 - left - 3)
        # 256 samples of light around 1 at edges: 0.5 / 16 each; a pixel of shift changes edges by 0.5
        assert np.sqrt(np.mean((ours - theirs) ** 2)) < 0.03, axis


def test_clipping_planes_that_hide_something_are_named(tmp_path):
    for camera in (number("far_clip", 4.2), number("near_clip", 3.9)):
        with pytest.raises(ValueError, match=r"near_clip .* and far_clip .* hide what \d+ of 1008 pixels see"):
            read_mitsuba(write(tmp_path, camera))
    read_mitsuba(write(tmp_path, number("near_clip", 0.5) + number("far_clip", 100)))


def test_what_mitsuba_rejects_while_it_renders_is_one_sentence(tmp_path):
    light = '<emitter type="constant"><spectrum type="blackbody" name="radiance">'
    light += '<float name="temperature" value="3200"/></spectrum></emitter>'
    for bands in (None, "rgb"):
        with pytest.raises(ValueError, match=r"scene\.xml: Mitsuba cannot (render|load) it: .*<rgb>") as error:
            read_mitsuba(write(tmp_path, light=light), bands=bands)
        assert "\n" not in str(error.value)
        assert "see above" not in str(error.value)


def test_a_light_that_needs_colour_is_read_in_colour(tmp_path):
    path = write(tmp_path, light='<emitter type="sunsky"/>')
    with pytest.raises(ValueError, match="render with bands='rgb'"):
        load_scene(str(path), 0, None, RenderSettings())
    scene, _ = load_scene(str(path), 0, None, RenderSettings(bands="rgb"))
    assert scene.bands is not None
    assert (scene.camera.height, scene.camera.width) == (28, 36)


def test_the_size_is_the_films_and_another_shape_is_reported(tmp_path):
    path = str(write(tmp_path))
    sizes = {(None, None): (28, 36), (14, None): (14, 18), (None, 18): (14, 18), (20, 20): (20, 20)}
    for (height, width), expected in sizes.items():
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            scene, _ = load_scene(path, 0, None, RenderSettings(height=height, width=width))
        assert (scene.camera.height, scene.camera.width) == expected
        assert [str(each.message) for each in said if "the horizontal one is" in str(each.message)] == (
            [] if expected != (20, 20) else [str(said[0].message)]
        )


def test_settings_that_change_the_picture_are_refused_by_name(tmp_path):
    hidden = '<integrator type="path"><boolean name="hide_emitters" value="true"/></integrator>'
    path = write(tmp_path)
    plain = path.read_text()
    for old, new, said in (
        ('<integrator type="path"/>', hidden, "hide_emitters is true"),
        (
            'type="perspective">',
            'type="thinlens"><float name="aperture_radius" value="0.1"/>',
            "its sensor is a ThinLensCamera",
        ),
        ('type="hdrfilm"', 'type="specfilm"', "Mitsuba cannot load it|its film is a"),
    ):
        path.write_text(plain.replace(old, new))
        with pytest.raises(ValueError, match=said):
            read_mitsuba(path)
    path.write_text(plain.replace('rfilter type="box"', 'rfilter type="lanczos"'))
    with pytest.warns(UserWarning, match="rfilter .* is left out"):
        read_mitsuba(path)
