"""The shipped recipe `lens`, made small: from rendering to the report, and its path in another scene."""

from __future__ import annotations

import re

import numpy as np
import pytest

import qsim.cli.program
import quiver.cli.program
from qsim.dataset import recipe
from qsim.optics.lens import Lens
from qsim.scene.camera_path import read_camera_path
from qsim.scenes import RECIPES, load
from qsim.streams.clip import Clip


@pytest.mark.slow  # twenty seconds of rendering and of kernels
def test_the_recipe_goes_from_rendering_to_the_report_and_its_path_to_another_scene(tmp_path):
    text = RECIPES["lens"].read_text(encoding="utf-8")
    text = re.sub(r"(?m)^(height|width) = \d+", r"\1 = 15", text).replace("seeds = [0, 1]", "seeds = [1]")
    text = text.replace("frames = 21", "frames = 7").replace("34.0", "25.0")
    (tmp_path / "lens.toml").write_text(text)
    assert recipe.load(tmp_path / "lens.toml").name == "lens"
    folder = tmp_path / "out"
    assert qsim.cli.program.main(["generate", str(tmp_path / "lens.toml"), "-o", str(folder)]) == 0
    clip = Clip.open(folder / "clips" / "macro_0001_x8")
    camera = load("macro", 1, 8.0).resized(15, 15).camera
    assert clip.camera.lens == camera.lens
    assert clip.camera.focal_pixels == pytest.approx(camera.focal_pixels, rel=1e-12)
    pose = camera.pose(3 / 2000)
    rays = camera.directions() @ pose[:3, :3].T
    points = pose[:3, 3] + rays * clip.depth(3)[..., None].astype(np.float64)
    y, x = np.mgrid[:15, :15] + 0.5
    still = clip.body_id(3) < 2  # floor and wall, which only the camera moves
    ends = camera.project(points, 4 / 2000)[0]
    assert still.sum() > 50
    np.testing.assert_allclose(
        clip.flow(3)[:, still], [ends[still, 0] - x[still], ends[still, 1] - y[still]], atol=0.01
    )
    assert qsim.cli.program.main(["check", str(folder), "--redraw"]) == 0
    stream = next(iter((clip.path / "streams").glob("*.json")))
    restored = str(tmp_path / "restored.npy")
    assert quiver.cli.program.main(["restore", str(stream), "--method", "likelihood", "-o", restored]) == 0
    assert qsim.cli.program.main(["report", str(clip.path), "-o", str(tmp_path / "page.html")]) == 0
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "corner moved by" in page
    assert "thin lens" in page
    assert qsim.cli.program.main(["convert", str(clip.path), str(tmp_path / "poses"), "--to", "nerfstudio"]) == 0
    path = read_camera_path(tmp_path / "poses" / "transforms.json")
    np.testing.assert_allclose(path.pose(5 / 2000), camera.pose(5 / 2000), atol=1e-9)
    assert path.focal_pixels == pytest.approx(camera.focal_pixels, rel=1e-12)
    other = text.replace('"macro"', '"text"').replace("[[streams]]", "[[streams]]  # as before")
    other = other.replace('name = "lens"', 'name = "along"\ncamera_path = "poses/transforms.json"')
    (tmp_path / "along.toml").write_text(other)
    assert qsim.cli.program.main(["generate", str(tmp_path / "along.toml"), "-o", str(tmp_path / "along")]) == 0
    along = Clip.open(tmp_path / "along" / "clips" / "text_0001_x8")
    np.testing.assert_allclose(along.info.poses[0], clip.info.poses[0], atol=1e-9)
    assert along.camera.lens == Lens(camera.lens.k1, camera.lens.k2)
