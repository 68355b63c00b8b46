"""Skinned bodies from end to end: the recipe `skinned`, a .glb as a scene, equal frames in any order, mistakes."""

from __future__ import annotations

import re

import numpy as np
import pytest
from gltf_files import arm

import qsim.cli.program
import quiver.cli.program
from qsim import scenes
from qsim.rendering.budget import Budget
from qsim.rendering.renderer import Renderer
from qsim.scenes import gltf_file
from qsim.streams.clip import Clip

CHEAP = Budget(samples=4, bounces=2)


def run(*words: object) -> int:
    return qsim.cli.program.main([str(word) for word in words])


@pytest.mark.slow  # half a minute of rendering and of kernels
def test_the_recipe_goes_from_rendering_to_the_report(tmp_path):
    text = scenes.RECIPES["skinned"].read_text(encoding="utf-8")
    text = re.sub(r"(?m)^(height|width) = 64", r"\1 = 31", text).replace("seeds = [0, 1]", "seeds = [1]")
    text = text.replace("frames = 21", "frames = 9").replace("34.0", "25.0")
    own = '[[scenes]]\nfamily = "arm.glb"\nspeed = 100\nsplit = "val"\n\n[[streams]]'
    (tmp_path / "skinned.toml").write_text(text.replace("[[streams]]", own))
    arm().write(tmp_path / "arm.glb")
    folder = tmp_path / "out"
    assert run("generate", tmp_path / "skinned.toml", "-o", folder, "--shard", "1/2") == 0
    assert run("generate", tmp_path / "skinned.toml", "-o", folder) == 0
    clip, arms = (Clip.open(folder / "clips" / name) for name in ("walker_0001_x8", "arm_0000_x100"))
    assert arms.info.reads.keys() == {"arm.glb"}
    for each in (clip, arms):
        assert np.hypot(*each.flow(4))[each.body_id(4) == 2].max() > 0.2
    alone = tmp_path / "alone"
    assert run("generate", tmp_path / "skinned.toml", "-o", alone) == 0
    assert np.array_equal(Clip.open(alone / "clips" / "walker_0001_x8").radiance(8), clip.radiance(8))
    assert run("check", folder, "--redraw") == 0
    stream = next(iter((clip.path / "streams").glob("*.json")))
    restored = tmp_path / "restored.npy"
    assert quiver.cli.program.main(["restore", str(stream), "--method", "likelihood", "-o", str(restored)]) == 0
    assert np.load(restored).shape == (9, 31, 31)
    assert run("report", clip.path, "-o", tmp_path / "page.html") == 0
    assert "walker" in (tmp_path / "page.html").read_text(encoding="utf-8")
    (tmp_path / "arm.glb").write_bytes((tmp_path / "arm.glb").read_bytes() + b"\0")
    assert run("generate", tmp_path / "skinned.toml", "-o", folder) != 0  # the file is another one


def test_frames_do_not_depend_on_the_order_in_which_they_are_rendered():
    made = scenes.load("walker", 3, 8.0).resized(13, 17)
    forward = Renderer(made, budget=CHEAP)
    frames = [forward.frame(t) for t in range(3)]
    alone = Renderer(made, budget=CHEAP).frame(2)
    assert np.array_equal(alone.radiance, frames[2].radiance)
    assert np.array_equal(alone.flow, frames[2].flow)
    part = Renderer(made, budget=CHEAP, crop=(3, 4, 9, 11)).frame(2)
    assert np.array_equal(part.flow, frames[2].flow[:, 3:12, 4:15])
    assert np.array_equal(part.body_id, frames[2].body_id[3:12, 4:15])


@pytest.mark.parametrize("seed", range(3))
def test_the_skin_of_a_walker_stays_whole(seed):
    """No edge of the mesh grows much: joints bend the skin and do not tear it."""
    body = scenes.load("walker", seed).bodies[2]
    edges = np.unique(np.sort(body.mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)), axis=0)

    def lengths(t):
        ends = body.vertices(t)[edges]
        return np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)

    rest = np.linalg.norm(np.diff(body.motion.rest[edges], axis=1)[:, 0], axis=1)
    long = rest > 1e-3
    assert long.sum() > 1000
    for t in (0.0, 0.013, 0.041):
        growth = lengths(t)[long] / rest[long]
        assert growth.max() < 3
        assert np.abs(growth - 1).max() > 0.05  # it bends


def test_an_animated_file_is_a_scene(tmp_path):
    path = arm().write(tmp_path / "arm.glb")
    scene = scenes.load(path, 1, speed=20.0)
    body = scene.bodies[2]
    assert (scene.name, scene.seed, scene.speed, body.name) == ("arm", 1, 20.0, "bend")
    longest = np.ptp(body.vertices(0.0), axis=0).max()
    assert longest == pytest.approx(0.26)
    assert body.vertices(0.0)[:, 1].min() == pytest.approx(scene.bodies[0].mesh.vertices[0, 1])  # on the floor
    assert np.array_equal(body.vertices(0.01), scenes.load(path, 1, 10.0).bodies[2].vertices(0.02))
    assert scenes.load(path, 2).to_dict() != scenes.load(path, 1).to_dict()
    assert gltf_file.played(scene, path).startswith("plays the animation bend of 1 s at 20 times its speed")


@pytest.mark.parametrize("command", ["render", "generate"])
def test_a_damaged_file_is_one_line_and_nothing_is_left(command, tmp_path, capsys):
    path = arm().write(tmp_path / "arm.glb")
    path.write_bytes(path.read_bytes()[:-9])
    recipe = '[recipe]\nname="t"\nframes=2\nheight=8\nwidth=8\nframe_rate=2000.0\n[[scenes]]\nfamily="arm.glb"\n'
    (tmp_path / "t.toml").write_text(recipe)
    words = ("render", path) if command == "render" else ("generate", tmp_path / "t.toml")
    assert run(*words, "-o", tmp_path / "out") == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert "arm.glb: truncated: " in lines[0]
    assert ("t.toml: scenes[0]: " in lines[0]) == (command == "generate")
    assert not (tmp_path / "out").exists()
