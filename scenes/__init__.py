"""Loads scenes: one file per family, each with `scene(seed=0, *, speed=1.0) -> Scene`.

`speed` multiplies every motion; 1 moves about 1 to 7 pixels per frame at 512 x 1024 and 2000 frames per second.
"""

from __future__ import annotations

import contextlib
import importlib.util
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

import numpy as np

from qsim.checks import suggest
from qsim.kinds import Speed
from qsim.records import convert
from qsim.scene import Scene
from qsim.scene.animated.gltf_body import GLTF_SUFFIXES, animations_in
from qsim.scenes import (
    asset_folder,
    crowd,
    drums,
    fan,
    fence,
    flag,
    gears,
    glass,
    glossy,
    gltf_file,
    lamp,
    macro,
    mains,
    pellets,
    plain,
    room,
    shadow,
    street,
    text,
    tumble,
    walker,
    wires,
)

Family = Callable[..., Scene]

FAMILIES: dict[str, Family] = {
    "crowd": crowd.scene,
    "drums": drums.scene,
    "fan": fan.scene,
    "fence": fence.scene,
    "flag": flag.scene,
    "gears": gears.scene,
    "glass": glass.scene,
    "glossy": glossy.scene,
    "lamp": lamp.scene,
    "macro": macro.scene,
    "mains": mains.scene,
    "pellets": pellets.scene,
    "plain": plain.scene,
    "room": room.scene,
    "shadow": shadow.scene,
    "street": street.scene,
    "text": text.scene,
    "tumble": tumble.scene,
    "walker": walker.scene,
    "wires": wires.scene,
}

RECIPES = {path.stem: path for path in sorted(Path(__file__).parent.glob("*.toml"))}  # of data sets, by name


def load(
    name: str | Path,
    seed: int = 0,
    speed: float = 1.0,
    *,
    along_path: bool = False,
    bands: Literal["rgb"] | None = None,
    camera: str | None = None,
    start: float | None = None,
) -> Scene:
    """Return the scene of a family, a .py file with `scene(seed, *, speed)`, a folder of assets, glTF or Mitsuba XML.

    `asset_folder.py` states what a folder may hold, `gltf_file.py` what becomes of an animated .glb or .gltf. An XML
    scene stands still and has no seed: a Python file that calls `qsim.read_mitsuba` moves its shapes. With
    `bands="rgb"` an XML scene, a glTF file and a folder with one are read in colour; others are coloured afterwards
    (colours.py). `camera` names one of a glTF file, and `start` [s] is the time of its animations at t = 0.
    `FileNotFoundError` for a missing file; `ValueError` for a name that is none of these, for a speed outside 0.001
    to 1000, and for one other than 1 that changes no motion of a .py or .xml scene, unless its camera will move
    `along_path`, on which the speed acts.
    """
    convert(float(speed), Speed, "speed")
    if name == "":
        raise ValueError("scene '': name a family, a file or a folder; '.' is the present folder")
    check_view(name, camera, start)
    if str(name) in FAMILIES:
        return FAMILIES[str(name)](seed, speed=speed)
    if str(name).endswith(".py"):
        return _of_program(Path(name), seed, speed, along_path)
    if str(name).endswith(".xml"):
        if speed != 1 and not along_path:
            raise ValueError(f"{name}: an XML scene has no motion, so speed {speed:g} changes nothing; leave it out")
        from qsim.rendering.mitsuba_xml import read_mitsuba

        return read_mitsuba(name, bands=bands)
    if str(name).endswith(GLTF_SUFFIXES):
        _check_moves(name, speed=speed != 1 and not along_path, start=start is not None)
        return gltf_file.scene(seed, speed=speed, file=name, camera=camera, start=start or 0.0, bands=bands)
    if Path(name).is_dir() and not (Path(name) / "clip.json").is_file():
        return asset_folder.scene(seed, speed=speed, folder=name, bands=bands)
    raise ValueError(_no_scene(name))


def _check_moves(name: str | Path, **given: bool) -> None:
    """Raise `ValueError` for what was given of the animations of a glTF file that has none."""
    for word, is_given in given.items():
        if is_given and not animations_in(name):
            raise ValueError(f"{name}: has no animation, nothing moves; leave {word}= out")


def check_view(name: str | Path, camera: str | None, start: float | None) -> None:
    """Raise `ValueError` for a camera or a start that a scene of this name cannot have: one that is no glTF file."""
    for word, value in (("camera", camera), ("start", start)):
        if value is not None and not str(name).endswith(GLTF_SUFFIXES):
            raise ValueError(f"{name}: {word} is for .glb and .gltf files; leave it out")


def _of_program(path: Path, seed: int, speed: float, along_path: bool) -> Scene:
    """Return the scene of a .py file; `ValueError` for a function that returns none, or that ignores the speed."""
    with _naming_mistakes(path):
        found = _from_file(path)(seed, speed=speed)
    if not isinstance(found, Scene):
        raise ValueError(f"{path}: scene() returned a {type(found).__name__}; it must return a qsim.scene.Scene")
    if speed != 1 and not along_path and _moves_alike(found, _from_file(path)(seed, speed=1.0)):
        raise ValueError(f"{path}: moves at speed {speed:g} as at 1; let scene() use its speed, or leave it out")
    return found


def _no_scene(name: str | Path) -> str:
    """Return why a name is none of a scene."""
    if (Path(name) / "clip.json").is_file():
        return f"{name}: is a clip, made from a scene already; name a family, a file or a folder"
    if str(name) in RECIPES or Path(name).suffix == ".toml":
        return f"{name}: is a recipe of a data set, not a scene; use `qsim generate {name}`"
    return (
        f"no scene family {str(name)!r}{suggest(str(name), FAMILIES)}; there are {', '.join(FAMILIES)}, "
        "or give a .py, .glb, .gltf or .xml file or a folder"
    )


def _moves_alike(one: Scene, other: Scene) -> bool:
    """Return whether camera, bodies, lamps and parts of two scenes have equal poses at some times."""
    moments = (0.0, *np.geomspace(5e-4, 10.0, 50).tolist())  # s
    return all(all(map(np.array_equal, _places(one, t), _places(other, t))) for t in moments)


def _places(scene: Scene, t: float) -> list[np.ndarray]:
    """Return the poses [4, 4] of everything at time t [s], and the vertices [V, 3] of deforming bodies."""
    things = (*scene.lights, *scene.bodies, *scene.parts)
    motions = [motion for thing in things if (motion := getattr(thing, "motion", None)) is not None]
    shapes = [body.vertices(t) for body in scene.bodies if body.deforms]
    return [scene.camera.pose(t), *(np.asarray(motion.pose(t)) for motion in motions), *shapes]


@contextlib.contextmanager
def _naming_mistakes(path: Path) -> Iterator[None]:
    """Convert an exception of a scene file to a `ValueError` with its line."""
    try:
        yield
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        lines = [frame.lineno for frame in frames if Path(frame.filename).resolve() == path.resolve()]
        if not lines:  # ours, about the complete file
            raise
        raise ValueError(f"{path}:{lines[-1]}: {type(error).__name__}: {error}") from error


def _from_file(path: Path) -> Family:
    if not path.is_file():
        raise FileNotFoundError(f"scene {path}: no such file")
    spec = importlib.util.spec_from_file_location(f"scene_{path.stem}", path)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    try:  # not by the spec's loader, which leaves a folder __pycache__ beside the user's file
        exec(compile(path.read_bytes(), str(path), "exec", dont_inherit=True), module.__dict__)
    except SyntaxError as error:
        raise ValueError(f"{path}:{error.lineno}: not valid Python: {error.msg}") from None
    if not callable(getattr(module, "scene", None)):
        raise ValueError(f"{path}: a scene file needs a function scene(seed=0, *, speed=1.0)")
    family: Family = module.scene
    return family
