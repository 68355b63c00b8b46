"""The comparison with Blender's Cycles: neutral files, turns, agreement and the page, without Blender."""

from __future__ import annotations

import ast
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from stats import critical_z

from qsim import scenes
from qsim.optics.camera import Camera
from qsim.optics.lens import Lens
from qsim.rendering.budget import Budget
from qsim.rendering.renderer import Renderer
from qsim.scene import (
    AreaLamp,
    Body,
    Conductor,
    Constant,
    Dielectric,
    Diffuse,
    EnvironmentImage,
    Mains,
    RoughPlastic,
    Scene,
    SunSky,
    Translation,
)
from qsim.scene.rotation import pose_matrix
from qsim.scene.shapes import ball, box, moved

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))
import cycles_page  # noqa: E402
import cycles_rows  # noqa: E402
import cycles_scene  # noqa: E402
import rows  # noqa: E402

TIMES = (0.0, 0.0005, 0.002)


def read(path: Path) -> tuple[dict, dict]:
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files}
    return json.loads(str(arrays.pop("description"))), arrays


def small(*bodies: Body, lights: tuple = (Constant(1.0),), **camera: object) -> Scene:
    view = Camera(1e-3, 2.8, 1e-3 / 16, 8, 12, origin=(0, 0, 2), **camera)
    return Scene("small", 0, view, lights, bodies or (Body("ball", ball(0.3)),))


# Neutral files


@pytest.mark.parametrize("family", cycles_rows.FAMILIES)
def test_a_neutral_file_places_every_vertex_where_the_scene_has_it(tmp_path, family):
    scene = cycles_scene.with_shared_materials(scenes.load(family, seed=4).resized(24, 40))
    cycles_scene.write(scene, TIMES, tmp_path / "scene.npz")
    description, arrays = read(tmp_path / "scene.npz")
    assert (description["height"], description["width"], description["frames"]) == (24, 40, 3)
    assert len(description["bodies"]) == len(scene.bodies)
    for i, body in enumerate(scene.bodies):
        vertices = arrays[f"body{i}_vertices"]
        faces = arrays[f"body{i}_faces"]
        assert set(map(tuple, faces.tolist())) <= set(map(tuple, body.mesh.faces.tolist()))
        for t, camera, pose in zip(TIMES, arrays["cameras"], arrays[f"body{i}_poses"], strict=True):
            world = vertices @ pose[:3, :3].T + pose[:3, 3]
            local = (world - camera[:3, 3]) @ camera[:3, :3]
            centre = np.array([40, 24]) / 2
            seen = local[:, :2] / local[:, 2:] * description["focal_pixels"] + centre
            at = body.vertices(t) @ body.pose(t)[:3, :3].T + body.pose(t)[:3, 3]
            np.testing.assert_allclose(seen, scene.camera.project(at, t)[0], rtol=1e-9, atol=1e-6)


def test_materials_and_lights_keep_their_values(tmp_path):
    lamp = AreaLamp((0, 2, 1), (0, 0, 0), 0.5, 0.8, 3.0, Translation((1.0, 0, 0), (0.0, 0, 0)))
    bodies = (Body("a", box(1, 1, 1), Diffuse(0.3)), Body("b", ball(0.3), Conductor(1.04, 2.59, 0.12)))
    cycles_scene.write(small(*bodies, lights=(Constant(0.4), lamp)), TIMES, tmp_path / "scene.npz")
    description, arrays = read(tmp_path / "scene.npz")
    assert description["bodies"] == [
        {"material": "diffuse", "reflectance": 0.3},
        {"material": "conductor", "eta": 1.04, "k": 2.59, "alpha": 0.12},
    ]
    assert description["lights"] == [{"light": "constant", "radiance": 0.4}, {"light": "area", "radiance": 3.0}]
    poses = arrays["light1_poses"]
    np.testing.assert_allclose(np.linalg.norm(poses[:, :3, :2], axis=1), [[0.25, 0.4]] * 3)
    np.testing.assert_allclose(poses[:, :3, 3], [[t, 2, 1] for t in TIMES])
    assert "body0_normals" not in arrays
    np.testing.assert_allclose(np.linalg.norm(arrays["body1_normals"], axis=1), 1, atol=1e-6)


def test_faces_without_an_area_are_left_out(tmp_path):
    """Each pole of a ball has one such triangle per meridian, which no ray hits."""
    mesh = ball(0.3, 16)
    cycles_scene.write(small(Body("ball", mesh)), TIMES, tmp_path / "scene.npz")
    faces = read(tmp_path / "scene.npz")[1]["body0_faces"]
    corners = mesh.vertices[faces]
    assert len(faces) < len(mesh.faces)
    assert np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).min() > 0


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        (small(Body("glass", ball(0.1), Dielectric())), "body glass: .* metals"),
        (small(Body("lacquer", ball(0.1), RoughPlastic(0.3))), "body lacquer: .* metals"),
        (small(lights=(SunSky(),)), "steady constant, pictured and area lights"),
        (small(lights=(Constant(1.0, Mains(100.0)),)), "steady constant, pictured and area lights"),
        (small(lens=Lens(k1=0.1)), "through a pinhole"),
        (small(aperture_blur=True), "through a pinhole"),
        (scenes.load("flag", seed=1), "it deforms"),
    ],
    ids=["glass", "lacquer", "sky", "flicker", "distortion", "thin lens", "deforming"],
)
def test_what_a_neutral_file_cannot_hold_is_refused(tmp_path, scene, message):
    with pytest.raises(ValueError, match=message):
        cycles_scene.write(scene, TIMES, tmp_path / "scene.npz")
    assert not list(tmp_path.iterdir())


def test_lacquer_becomes_diffuse_and_nothing_else_changes():
    bodies = (Body("a", ball(0.1), RoughPlastic(0.37)), Body("b", ball(0.1), Conductor()), Body("c", ball(0.1)))
    found = cycles_scene.with_shared_materials(small(*bodies)).bodies
    assert isinstance(found[0].material, Diffuse)
    assert found[0].material.reflectance == 0.37
    assert [each.material for each in found[1:]] == [each.material for each in bodies[1:]]


@pytest.mark.parametrize("rotation", [0.0, 0.7, -2.9])
@pytest.mark.parametrize("target", [(0, 0.2, 1), (1, -0.4, 0.1), (-0.5, 0.6, -1)])
def test_a_map_of_surroundings_is_what_our_renderer_sees(rotation, target):
    """A camera in the empty; the map is interpolated at the pixel's direction, Mitsuba's is the mean over the pixel."""
    picture = np.random.default_rng(5).uniform(0.5, 2, (6, 12)).astype(np.float32)
    camera = Camera(1e-3, 2.8, 1e-3 / 32, 32, 32, target=target, origin=(0, 0, 0))
    far = Body("far", moved(ball(1e-3), pose_matrix(None, (0, 0, 50.0) if target[2] < 0 else (0, 0, -50.0))))
    scene = Scene("empty", 0, camera, (EnvironmentImage(picture, 1.0, rotation),), (far,))
    renderer = Renderer(scene, budget=Budget(32, 1))
    seen = renderer.halves([0.0], renderer.budget, renderer.key(0)).mean(axis=0)
    found = cycles_scene.finer_map(picture, rotation)
    direction = camera.directions() @ camera.pose()[:3, :3].T
    azimuth = np.arctan2(direction[..., 0], direction[..., 2])
    up = direction[..., 1]
    zenith = np.arccos(up / np.linalg.norm(direction, axis=-1))
    height, width = found.shape
    rows = np.clip(np.floor(zenith / np.pi * height).astype(int), 0, height - 1)
    columns = np.floor((0.5 - azimuth / (2 * np.pi)) * width).astype(int) % width
    assert np.sqrt(np.mean((found[rows, columns] - seen) ** 2)) < 0.05  # half a texel of a slope of about 1
    assert np.corrcoef(found[rows, columns].ravel(), seen.ravel())[0, 1] > 0.98


# Agreement and choice


def halves(rng: np.random.Generator, picture: np.ndarray, noise: float) -> np.ndarray:
    return picture + noise * rng.standard_normal((2, *picture.shape))


def test_agreement_is_that_of_the_pictures_without_their_noise():
    """Equal pictures with much noise agree better than they seem to; unequal ones as much as they differ."""
    rng = np.random.default_rng([22, 1])
    picture = rng.uniform(0.2, 0.8, (3, 64, 80))
    found = cycles_rows.agreement(halves(rng, picture, 0.02), halves(rng, picture, 0.02), 1.0)
    assert found["as_seen"] == pytest.approx(-20 * np.log10(0.02), abs=0.3)
    assert found["difference"] > found["as_seen"] + 10
    assert abs(found["mean"]) < critical_z() * found["mean_error"]
    assert found["mean_error"] == pytest.approx(0.02 / np.sqrt(picture.size) / 0.5, rel=0.1)
    other = picture + 0.01 * rng.choice((-1, 1), picture.shape)
    found = cycles_rows.agreement(halves(rng, picture, 0.002), halves(rng, other, 0.002), 1.0)
    assert 39.5 < found["difference"] < 40.0  # 40, less the standard errors


def test_agreement_and_error_are_clamped_at_white():
    picture = np.full((1, 8, 10), 0.5)
    picture[0, 0, 0] = 7.0
    brighter = np.where(picture > 1, 9.0, picture)
    twice = np.stack([picture, picture])
    assert cycles_rows.agreement(twice, np.stack([brighter, brighter]), 1.0)["difference"] == pytest.approx(80)
    assert cycles_rows.reached(brighter + 0.01, twice, 1.0) == pytest.approx(40, abs=0.1)


SETTINGS = [
    {"denoiser": "OIDN", "samples": 1, "reached": 39.0, "wall_seconds": 0.2, "processor_seconds": 0.4},
    {"denoiser": "OIDN", "samples": 2, "reached": 42.0, "wall_seconds": 0.3, "processor_seconds": 0.5},
    {"denoiser": "raw", "samples": 32, "reached": 41.0, "wall_seconds": 0.4, "processor_seconds": 0.45},
]
OURS = {"samples": 8, "neighbours": 0, "denoise": True, "bounces": 4, "reached": 41.5, "choosing_seconds": 3.0}
OURS |= {"wall_seconds": 0.05, "processor_seconds": 0.1}
AGREED = {"difference": 55.5, "as_seen": 51.0, "mean": 0.0002, "mean_error": 0.0001}


def row(*, quiet: bool = True) -> dict:
    return {
        "plan": {"level": 40.0, "threads": 2, "frames": 16},
        "processor": "P",
        "quiet": quiet,
        "agreement": AGREED,
    } | {
        "ours": [OURS, OURS | {"neighbours": 2, "wall_seconds": 0.06, "processor_seconds": 0.09}],
        "cycles": SETTINGS,
    }


def test_the_cheapest_setting_reaches_the_level_and_depends_on_the_clock():
    assert cycles_page.cheapest(SETTINGS, 40.0, "wall_seconds") == SETTINGS[1]
    assert cycles_page.cheapest(SETTINGS, 40.0, "processor_seconds") == SETTINGS[2]
    assert cycles_page.cheapest(SETTINGS, 38.0, "wall_seconds") == SETTINGS[0]
    assert cycles_page.cheapest(SETTINGS, 45.0, "wall_seconds") is None


def test_the_page_states_ratios_the_target_and_marks():
    page = cycles_page.page({"plain-128x256": row()})
    assert "| plain-128x256 | 8, denoised: 41.5 dB | 0.050 | 2, OIDN: 42.0 dB | 0.300 | 6.0 |" in page
    assert "as asked, is reached" in page
    assert "agree to 55.5 dB or better" in page
    assert "clip of 16 frames" in page
    assert "beside other programs" not in page
    marked = cycles_page.page({"plain-128x256": row(quiet=False), "room-128x256": row()})
    line = "| plain-128x256 \\* | 8, 2 neighbours, denoised: 41.5 dB | 0.090 | 32, raw: 41.0 dB | 0.450 | 5.0 |"
    assert line in marked
    assert "in processor seconds" in marked
    assert "beside other programs" in marked
    short = {"plain": row() | {"cycles": SETTINGS[:1]}}
    assert "| none of those tried | – | – | none of those tried | – | – |" in cycles_page.page(short)
    slow = {"plain": row(), "room": row() | {"ours": [OURS | {"wall_seconds": 0.07}]}}
    assert "**not reached**" in cycles_page.page(slow)


class FakeClip:
    """Writes down when it is rendered, here and as Cycles; its error halves with four times the samples."""

    def __init__(self, name: str, log: list[str]) -> None:
        self.name = name
        self.log = log
        self.budget = Budget(8, 4)

    def render(self, samples: int = 0, bounces: int = 0, *options: str) -> dict[str, np.ndarray]:
        self.log.append(f"{self.name} {samples} {' '.join(options)}".strip() if samples else self.name)
        assert not samples or bounces == 4
        return {"radiance": np.full((16, 2, 3), float(samples)), "seconds": np.full((16, 2), 0.1 * samples)}


def test_programs_take_turns_and_samples_stop_when_there_are_enough(monkeypatch):
    monkeypatch.setattr(cycles_rows, "DENOISERS", {"fast": "FAST/FAST", "raw": None})
    log: list[str] = []
    plan = replace(cycles_rows.Plan(), most=8)
    found = cycles_rows.in_turns(FakeClip("cycles", log), [FakeClip("ours", log)], plan, lambda p: p.max() >= 4)
    one = [f"cycles {samples} --denoise FAST/FAST" for samples in (1, 2, 4)] + [f"cycles {n}" for n in (1, 2, 4)]
    assert log[1::2] == one * plan.rounds
    assert set(log[::2]) == {"ours"}
    assert list(found) == [(kind, samples) for kind in ("fast", "raw") for samples in (1, 2, 4)]
    assert {len(timed.seconds) for timed in found.values()} == {15 * plan.rounds}  # without first frames
    assert found["raw", 4].pictures.shape == (3, 2, 3)


# The program


def test_a_python_without_blender_is_one_sentence(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(cycles_rows, "use_only", lambda threads: None)
    for python in (sys.executable, str(tmp_path / "none")):
        assert cycles_rows.main(["--cycles", python, "--tiny", "--out", str(tmp_path / "rows")]) == 2
        found = capsys.readouterr()
        assert (found.out, found.err.count("\n")) == ("", 1)
        assert "expected a Python that imports bpy" in found.err
    assert not list((tmp_path / "rows").iterdir())


def test_rows_are_made_once_and_marked_ones_again_on_quiet_cores(monkeypatch, tmp_path):
    made = []
    own = {key: value for key, value in row().items() if key in ("agreement", "ours", "cycles")}
    monkeypatch.setattr(cycles_rows, "check", lambda python: None)
    monkeypatch.setattr(cycles_rows, "use_only", lambda threads: None)
    monkeypatch.setattr(rows, "wait_for_quiet", lambda: None)
    monkeypatch.setattr(cycles_rows, "measure", lambda family, plan, python: made.append(family) or own)
    line = ["--cycles", "python", "--rows", "plain", "--out", str(tmp_path / "rows")]
    for cores, words, count in ((1.0, ["--busy"], 1), (1.0, ["--busy"], 1), (0.0, [], 2), (0.0, [], 2)):
        monkeypatch.setattr(rows.Watch, "others", lambda self, cores=cores: cores)
        assert cycles_rows.main([*line, *words]) == 0
        assert len(made) == count
        stored = json.loads((tmp_path / "rows" / "plain-128x256.json").read_text())
        assert stored["quiet"] == (cores == 0.0)
        assert ("beside other programs" in (tmp_path / "rows.md").read_text()) == (cores > 0)


def test_pictures_that_do_not_agree_are_refused_before_a_time_is_measured(monkeypatch):
    """Cycles is replaced by a program whose light is 1 % brighter."""
    halves_of = Renderer.halves
    seen: dict[tuple[float, int], np.ndarray] = {}

    def noted(self: Renderer, *words: object) -> np.ndarray:
        seen["last", len(seen)] = halves_of(self, *words)
        return seen["last", len(seen) - 1]

    monkeypatch.setattr(Renderer, "halves", noted)
    monkeypatch.setattr(cycles_rows.Cycles, "converged", lambda self: 1.01 * np.stack(list(seen.values()), axis=1))
    plan = cycles_rows.Plan(16, 24, frames=2, judged=(0, 1), reference=4)
    with pytest.raises(ValueError, match=r"the converged pictures agree to [0-9.]+ dB only"):
        cycles_rows.measure("plain", plan, "python")


def imported(path: Path) -> set[str]:
    text = path.read_text(encoding="utf-8")
    nodes = list(ast.walk(ast.parse(text))) if "bpy" in text or "cycles_render" in text else []
    names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    names += [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)]
    return {name.split(".")[0] for name in names}


def test_two_scripts_import_blender_and_nothing_imports_them():
    scripts = [
        p
        for folder in ("qsim", "quiver", "scenes", "tests", "benchmarks", "docs")
        for p in (ROOT / folder).rglob("*.py")
    ]
    assert len(scripts) > 300
    blender = {"cycles_render.py", "blender_scenes.py"}
    assert {p.name for p in scripts if "bpy" in imported(p)} == blender
    assert not [p for p in scripts if imported(p) & {"cycles_render", "blender_scenes"}]
    ours = {"qsim", "quiver", "scenes", "tests"} | {p.stem for p in (ROOT / "benchmarks").glob("*.py")}
    for name in blender:
        assert not imported(ROOT / "benchmarks" / name) & ours
