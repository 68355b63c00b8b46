"""Makes scenes of a user's glTF file: one with a camera is a scene of its own, one without is a body on a floor."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from qsim.scene import Body, Diffuse, Motion, Scene, Still, animated_file, read_gltf
from qsim.scene.animated.gltf_body import animations_in
from qsim.scene.animated.gltf_scene import cameras_in, gltf_parts, in_first_pose
from qsim.scenes import common
from qsim.scenes.colours import with_parts
from qsim.scenes.common import between, pick

SIZE = 0.26  # m, the longest side of the body


def scene(
    seed: int = 0,
    *,
    speed: float = 1.0,
    file: str | Path,
    camera: str | None = None,
    start: float = 0.0,
    bands: Literal["rgb"] | None = None,
) -> Scene:
    """Return the scene of a .glb or .gltf file with a camera as `read_gltf` does, or a body on a floor.

    Without a name the seed chooses among the cameras of the file: seed 0 has the first, and so on, again and again.
    """
    names = cameras_in(file)
    if names:
        chosen = names[seed % len(names)] if camera is None else camera
        return read_gltf(file, camera=chosen, speed=speed, start=start, seed=seed, bands=bands)
    if camera is not None:
        raise ValueError(f"{file}: has no camera; export the cameras, too, or leave camera out")
    return _standing(seed, speed, file, start, bands)


def _standing(seed: int, speed: float, file: str | Path, start: float, bands: Literal["rgb"] | None) -> Scene:
    """Return the body of a .glb or .gltf file, 26 cm long or high, in the first pose of one of its animations at t = 0.

    The seed chooses the animation, the direction of the body, textures and light; a body with materials of its own
    keeps them, each as a body. `speed` is that of the animation, which starts again at its end. Errors are those of
    `animated_file` and `read_gltf`.
    """
    rng = np.random.default_rng([seed, 19])
    names = animations_in(file)
    name = pick(rng, names) if names else None
    yaw = between(rng, -0.8, 0.8)
    upright = Still((0, 0, 0), common.upright(yaw))
    parts: tuple[Body, ...] = ()
    if name is not None:
        parts = gltf_parts(file, SIZE, pose=upright.pose(0.0), animation=name, speed=speed, start=start, bands=bands)
    parts = tuple(replace(part, name=f"{name}, part {k}") for k, part in enumerate(parts))
    bare = () if parts else (_bare(file, name, speed, start, upright),)
    low = min(float(in_first_pose(body)[:, 1].min()) for body in (*parts, *bare))
    backdrops = common.backdrop(rng), common.backdrop(rng)
    drawn = common.paint(rng, common.surface(rng))
    bodies = (
        common.floor(Diffuse(backdrops[0]), 2.4, y=low, z=-0.2),
        common.wall(Diffuse(backdrops[1]), 2.4, 1.2, z=-0.6, y=0.35),
        *(replace(body, material=drawn) for body in bare),
    )
    view = common.camera((between(rng, -0.08, 0.08), between(rng, 0.02, 0.12), 0.65), (0, 0, 0), 0.5)
    return with_parts(Scene(Path(file).stem, seed, view, (common.sun(rng),), bodies, speed), parts, bands)


def _bare(file: str | Path, name: str | None, speed: float, start: float, carrier: Motion) -> Body:
    """Return the complete body of a file that states no material."""
    mesh, motion = animated_file(file, SIZE, animation=name, speed=speed, start=start, carrier=carrier)
    return Body(name or "body", mesh, motion=motion)


def played(scene: Scene, file: str | Path) -> str:
    """Return a line that states what a scene of this file shows, how fast it moves, and what follows its end."""
    motions = [scene.camera.motion, *(body.motion for body in scene.bodies)]
    clocks = [clock for motion in motions if (clock := getattr(motion, "clock", None)) is not None]
    if cameras_in(file) or not clocks:
        shown = f"shows {len(scene.bodies)} bodies of {file}"
        if not clocks:
            return f"{shown}, at rest"
        rate = f"again and again, at {scene.speed:g} times their speed"
        return f"{shown} and plays its animations of {clocks[0].length:g} s, {rate}"
    name = scene.bodies[-1].name.partition(", part ")[0]
    return (
        f"plays the animation {name} of {clocks[0].length:g} s at {clocks[0].speed:g} times its speed, again and "
        "again; the seed chooses among those of the file, a scene in Python (animated_file) anything else"
    )
