"""Makes scenes of a user's glTF file: one with a camera is a scene of its own, one without is a body on a floor."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from qsim.scene import Body, Diffuse, Scene, Skinned, Still, animated_file, read_gltf
from qsim.scene.animated.gltf_body import animations_in
from qsim.scene.animated.gltf_scene import cameras_in
from qsim.scene.shapes import mesh_material
from qsim.scenes import common
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
    return _standing(seed, speed, file, start)


def _standing(seed: int, speed: float, file: str | Path, start: float) -> Scene:
    """Return the body of a .glb or .gltf file, 26 cm long or high, in the first pose of one of its animations at t = 0.

    The seed chooses the animation, the direction of the body, textures and light; a body with colours of its own keeps
    them. `speed` is that of the animation, which starts again at its end. `FileNotFoundError` and `ValueError` as
    `animated_file` and `mesh_material`.
    """
    rng = np.random.default_rng([seed, 19])
    names = animations_in(file)
    name = pick(rng, names) if names else None
    yaw = between(rng, -0.8, 0.8)
    carrier = Still((0, 0, 0), common.upright(yaw))
    mesh, motion = animated_file(file, SIZE, animation=name, speed=speed, start=start, carrier=carrier)
    low = float(mesh.vertices[:, 1].min())
    own = mesh_material(file)
    backdrops = common.backdrop(rng), common.backdrop(rng)
    drawn = common.paint(rng, common.surface(rng))
    bodies = (
        common.floor(Diffuse(backdrops[0]), 2.4, y=low, z=-0.2),
        common.wall(Diffuse(backdrops[1]), 2.4, 1.2, z=-0.6, y=0.35),
        Body(name or "body", mesh, drawn if own is None else common.finished(own, drawn), motion),
    )
    view = common.camera((between(rng, -0.08, 0.08), between(rng, 0.02, 0.12), 0.65), (0, 0, 0), 0.5)
    return Scene(Path(file).stem, seed, view, (common.sun(rng),), bodies, speed)


def played(scene: Scene, file: str | Path) -> str:
    """Return a line that states what a scene of this file shows, how fast it moves, and what follows its end."""
    names = cameras_in(file)
    if names:
        shown = f"shows {len(scene.bodies)} bodies of {file}"
        motions = [scene.camera.motion, *(body.motion for body in scene.bodies)]
        clocks = [getattr(motion, "clock", None) for motion in motions]
        lengths = [clock.length for clock in clocks if clock is not None]
        if not lengths:
            return f"{shown}, at rest"
        rate = f"again and again, at {scene.speed:g} times their speed"
        return f"{shown} and plays its animations of {lengths[0]:g} s, {rate}"
    body = scene.bodies[-1]
    assert isinstance(body.motion, Skinned)
    clock = body.motion.clock
    return (
        f"plays the animation {body.name} of {clock.length:g} s at {clock.speed:g} times its speed, again and again; "
        "--seed chooses among those of the file, a scene in Python (animated_file) anything else"
    )
