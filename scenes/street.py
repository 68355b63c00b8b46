"""Makes a street: facades, granite, grass, gravel, cloth, foliage, water and lamps, under what a held camera does.

    seed = 10 * (which motion) + (which subject), and 60 for every other draw of the same pair

SUBJECTS and MOTIONS name both. Photographs follow from the seed, too: seeds below 60 show those of TEST, the others
those of OTHERS, so that a data set can keep a part for tests.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from qsim.scene import (
    AreaLamp,
    Body,
    Composition,
    Conductor,
    Constant,
    Diffuse,
    Flag,
    Glow,
    Keyframes,
    Light,
    Mains,
    Motion,
    Oscillation,
    Ripple,
    RoughPlastic,
    Scene,
    Shake,
    Spin,
    Still,
    Texture,
    Translation,
    Wave,
    textures,
)
from qsim.scene.rotation import exponential, pose_matrix, vector
from qsim.scene.shapes import ball, box, cylinder, merged, moved, sheet
from qsim.scenes import common
from qsim.scenes.common import any_angle, between, sign

TEST = ("astronaut", "moon", "rocket")  # photographs of the seeds that show each pair for the first time
OTHERS = ("camera", "cat", "coffee", "coins")

VIEW = 0.6  # rad, vertical field
EYE = 1.5  # m, height of the camera
WALL = 6.0  # m, distance of the facade
BLOW = 0.012  # s at speed 1, when the camera is struck
RINGS = 0.06  # s at speed 1, for which it vibrates
KEY = 0.0005  # s at speed 1, between poses of a struck camera


def scene(seed: int = 0, *, speed: float = 1.0) -> Scene:
    """Return the street of a seed; light that changes, of motion "light", does not depend on `speed`."""
    rng = np.random.default_rng([seed, 23])
    subject = subject_of(seed)
    motion = motion_of(seed)
    photographs = TEST if seed < len(SUBJECTS) * len(MOTIONS) else OTHERS
    bodies = SUBJECTS[subject](rng, speed, photographs)
    if motion == "light":
        bodies.append(passer(rng, speed))
    view = replace(
        common.camera((0.0, EYE, 0.0), (between(rng, -0.4, 0.4), between(rng, 0.9, 1.4), -WALL), VIEW),
        motion=MOTIONS[motion](rng, speed),
    )
    lights = night(rng) if subject == "lamps" else day(rng, changes=motion == "light")
    return Scene("street", seed, view, lights, tuple(bodies), speed)


def subject_of(seed: int) -> str:
    """Return the name of what a seed shows."""
    return tuple(SUBJECTS)[seed % len(SUBJECTS)]


def motion_of(seed: int) -> str:
    """Return the name of what the camera of a seed does."""
    return tuple(MOTIONS)[seed // len(SUBJECTS) % len(MOTIONS)]


# ---- What the camera does; it looks along its own z, x is right and y is down


def hand(rng: np.random.Generator, speed: float) -> Motion:
    """Return the shake of a hand that slow footage shows when it is played fast: three waves for each axis.

    Their rates lie a factor of three apart. Within eleven frames the direction changes, so that no path with one
    velocity and one acceleration follows it.
    """
    turns = []
    for amplitude, frequency in ((0.06, 9.0), (0.018, 27.0), (0.005, 81.0)):
        for axis in np.eye(3) * (1.0, 1.0, 0.7):
            size = amplitude * between(rng, 0.4, 1.0) * axis
            turns.append(Wave(vector(size), speed * frequency * between(rng, 0.8, 1.25), any_angle(rng)))
    return Shake(tuple(turns))


def impact(rng: np.random.Generator, speed: float) -> Motion:
    """Return a camera that drifts, is struck after `BLOW`, and rings out: a damped rotation."""
    times = np.arange(0.0, BLOW + RINGS, KEY)
    after = np.maximum(times - BLOW, 0.0)
    axis = rng.normal(0, (1.0, 1.0, 0.4))
    frequency = between(rng, 40.0, 70.0)
    ringing = 0.028 * np.exp(-after / 0.015) * np.sin(2 * np.pi * frequency * after)
    drift = np.outer(times, rng.normal(0, 0.8, 3))
    turns = np.outer(ringing, axis / np.linalg.norm(axis)) + drift
    return Keyframes(
        tuple(float(t) for t in times / speed), ((0.0, 0.0, 0.0),) * len(times), tuple(vector(turn) for turn in turns)
    )


def drive(rng: np.random.Generator, speed: float) -> Motion:
    """Return a drive along the street at 14 to 28 m/s: near things pass faster than far ones."""
    velocity = speed * sign(rng) * np.array([between(rng, 14.0, 28.0), 0.0, between(rng, -4.0, 4.0)])
    return Translation(vector(velocity), vector(-velocity * common.CLIP / 2 / speed))


def roll(rng: np.random.Generator, speed: float) -> Motion:
    """Return a roll about the line of sight, with a step forward."""
    rate = speed * sign(rng) * between(rng, 5.0, 12.0)
    ahead = speed * np.array([0.0, 0.0, between(rng, 4.0, 10.0)])
    return Composition(Translation(vector(ahead)), Spin((0.0, 0.0, 1.0), rate, -rate * common.CLIP / 2 / speed))


def at_rest(rng: np.random.Generator, speed: float) -> None:
    """Return no motion: the camera stands."""


def handled_drive(rng: np.random.Generator, speed: float) -> Motion:
    """Return a drive by hand: both at once."""
    return Composition(drive(rng, 0.5 * speed), hand(rng, 0.5 * speed))


# ---- Light


def day(rng: np.random.Generator, *, changes: bool) -> tuple[Light, ...]:
    """Return sky and a large lamp for a low sun; the lamp may flicker by 40 to 80 %, most of all light."""
    flicker = Mains(between(rng, 80.0, 120.0), between(rng, 0.4, 0.8), any_angle(rng)) if changes else None
    key = AreaLamp(
        (between(rng, -4.0, 4.0), 7.0, 1.0), (0.0, 1.0, -WALL), 2.0, 2.0, between(rng, 40.0, 80.0), flicker=flicker
    )
    return (Constant(between(rng, 0.25, 0.5)), key)


def night(rng: np.random.Generator) -> tuple[Light, ...]:
    """Return the sky of a night; the lamps of the street are bodies."""
    return (Constant(between(rng, 0.1, 0.15)),)


# ---- Things


def facade_picture(rng: np.random.Generator, columns: int, rows: int, cell: int = 24) -> textures.Picture:
    """Return a wall of equal windows with frames and sills, float32 [rows * cell, columns * cell]; it tiles."""
    y, x = np.mgrid[: rows * cell, : columns * cell] / cell
    u = x % 1.0
    v = y % 1.0
    tone = rng.uniform(0.04, 0.2, (rows, columns))[y.astype(int), x.astype(int)]
    wall = between(rng, 0.35, 0.7) * (0.9 + 0.2 * textures.noise(rng, y.shape, 0.6))
    opening = (np.abs(u - 0.5) < 0.3) & (np.abs(v - 0.45) < 0.34)
    pane = (np.abs(u - 0.5) < 0.25) & (np.abs(v - 0.45) < 0.29) & (np.abs(u - 0.5) > 0.03)
    sill = (np.abs(u - 0.5) < 0.36) & (np.abs(v - 0.84) < 0.04)
    picture = np.where(opening, 0.8, wall)
    picture = np.where(pane, tone, picture)
    return np.clip(np.where(sill, 0.85, picture), 0.02, 0.95).astype(np.float32)


def granite_picture(rng: np.random.Generator, size: int = 768) -> textures.Picture:
    """Return granite, float32 [size, size]: grains of three minerals with dark flecks, down to single texels."""
    grains = sum(textures.noise(rng, (size, size), slope, cut) for slope, cut in ((0.2, 60.0), (0.6, 20.0), (1.0, 4.0)))
    flecks = textures.noise(rng, (size, size), 0.3, 80.0)
    return textures.levels(np.where(flecks > 0.75, 0.3 * grains, grains), 0.05, 0.85, contrast=1.5)


def weave_picture(rng: np.random.Generator, threads: int) -> textures.Picture:
    """Return woven cloth, float32 [8 * threads, 8 * threads]: threads over and under, two tones; it tiles."""
    y, x = (np.mgrid[: 8 * threads, : 8 * threads] + 0.5) / 8
    over = (np.floor(x) + np.floor(y)) % 2 == 0
    along = np.abs(np.where(over, y, x) % 1.0 - 0.5)
    tones = rng.uniform(0.15, 0.85, 2)
    stripes = np.where(np.where(over, y, x) // 8 % 2 == 0, tones[0], tones[1])
    return np.clip(stripes * (1.1 - 1.4 * along**2), 0.03, 0.9).astype(np.float32)


def wall(texture: Texture, width: float = 60.0, height: float = 12.0, distance: float = WALL) -> Body:
    """Return the wall across the street."""
    return common.wall(Diffuse(texture), width, height, z=-distance, y=height / 2)


def ground(texture: Texture, gloss: float | None = None) -> Body:
    """Return the ground, wet with a gloss."""
    material = Diffuse(texture) if gloss is None else RoughPlastic(texture, roughness=gloss)
    return common.floor(material, 60.0, z=-WALL)


def asphalt(rng: np.random.Generator) -> Texture:
    """Return dark ground with fine grain."""
    grain = textures.noise(rng, (768, 768), 0.25, 20.0)
    return Texture(textures.levels(grain, 0.08, 0.3), repeat=(40.0, 40.0))


def bricks(rng: np.random.Generator) -> Texture:
    """Return a wall of fine bricks."""
    return Texture(textures.levels(textures.bricks(rng, 24, 12), 0.12, 0.7), repeat=(20.0, 5.0))


def posts(rng: np.random.Generator, count: int = 5) -> list[Body]:
    """Return thin posts on the near pavement, which pass before the wall."""
    made = []
    for i in range(count):
        place = (between(rng, -3.0, 3.0), 1.1, -between(rng, 2.2, 5.0))
        post = moved(cylinder(between(rng, 0.02, 0.06), 2.2, 24), pose_matrix(None, place))
        made.append(Body(f"post {i}", post, common.paint(rng, Texture(textures.stripes(8, 0.1, 0.8)))))
    return made


def passer(rng: np.random.Generator, speed: float) -> Body:
    """Return a crate that is carried past at walking height, for a camera at rest."""
    velocity = speed * sign(rng) * np.array([between(rng, 10.0, 20.0), 0.0, 0.0])
    middle = np.array([between(rng, -0.4, 0.4), 1.2, -3.5])
    crate = box(0.6, 0.5, 0.4, 0.5)
    path = Translation(vector(velocity), vector(middle - velocity * common.CLIP / 2 / speed))
    return Body("passer", crate, common.paint(rng, common.backdrop(rng)), path)


Photographs = Sequence[str]


def facade(rng: np.random.Generator, speed: float, photographs: Photographs) -> list[Body]:
    """Return a house with hundreds of equal windows."""
    columns = int(rng.integers(10, 18))
    picture = facade_picture(rng, columns, columns)
    repeat = (60.0 / 5.0, 12.0 / 5.0)  # a picture is 5 m wide and high
    return [wall(Texture(picture, repeat)), ground(asphalt(rng)), *posts(rng, 2)]


def granite(rng: np.random.Generator, speed: float, photographs: Photographs) -> list[Body]:
    """Return steps and a wall of granite."""
    stone = granite_picture(rng)
    steps = [
        Body(
            f"step {i}",
            moved(box(8.0, 0.25, 0.6, 5.0), pose_matrix(None, (0.0, 0.125 + 0.25 * i, -4.0 - 0.6 * i))),
            Diffuse(Texture(stone)),
        )
        for i in range(4)
    ]
    return [wall(Texture(stone, (6.0, 1.2))), ground(Texture(stone, (10.0, 10.0))), *steps]


def grass(rng: np.random.Generator, speed: float, photographs: Photographs) -> list[Body]:
    """Return a steep lawn below a brick wall."""
    lawn = textures.photograph("grass", 0.03, 0.6, repeat=(20.0, 5.0))
    slope = moved(sheet(60.0, 12.0), pose_matrix(exponential((-0.9, 0, 0)), (0.0, 1.0, -WALL)))
    return [Body("lawn", slope, Diffuse(lawn)), wall(bricks(rng), distance=WALL + 1.5), *posts(rng, 3)]


def gravel(rng: np.random.Generator, speed: float, photographs: Photographs) -> list[Body]:
    """Return a heap of gravel in front of a wall."""
    stones = textures.photograph("gravel", 0.05, 0.7, repeat=(30.0, 7.5))
    slope = moved(sheet(60.0, 15.0), pose_matrix(exponential((-0.7, 0, 0)), (0.0, 0.4, -WALL)))
    return [Body("gravel", slope, Diffuse(stones)), wall(bricks(rng), distance=WALL + 2.0), *posts(rng, 2)]


def cloth(rng: np.random.Generator, speed: float, photographs: Photographs) -> list[Body]:
    """Return two woven banners that flutter before a wall."""
    bodies = [wall(bricks(rng)), ground(asphalt(rng))]
    for i, x in enumerate((-1.1, 0.25)):
        banner = moved(sheet(1.2, 1.6, 48, 48), pose_matrix(None, (0.6, 0.0, 0.0)))
        waves = tuple(
            Ripple(1.2 * share, 1.2 * length, speed * between(rng, low, high), float(rng.normal(0, 2)), any_angle(rng))
            for share, length, low, high in ((0.08, 0.8, 6, 10), (0.03, 0.4, 10, 16))
        )
        pole = Still((x, between(rng, 1.1, 1.5), -4.5), common.upright(between(rng, -0.5, 0.5)))
        weave = Texture(weave_picture(rng, int(rng.integers(24, 48))))
        bodies.append(Body(f"banner {i}", banner, Diffuse(weave), Flag(banner.vertices, waves, pole)))
    return bodies


def foliage(rng: np.random.Generator, speed: float, photographs: Photographs) -> list[Body]:
    """Return branches with hundreds of leaves at several depths, which sway before a wall."""
    bodies = [wall(bricks(rng)), ground(asphalt(rng))]
    for i in range(9):
        leaves = []
        for _ in range(90):
            turn = exponential(rng.normal(0, 0.9, 3))
            size = between(rng, 0.06, 0.16)
            leaf = sheet(size, 0.6 * size)
            leaves.append(moved(leaf, pose_matrix(turn, rng.normal(0, (0.5, 0.4, 0.25)))))
        centre = (between(rng, -1.6, 1.6), between(rng, 0.6, 2.2), -between(rng, 3.0, 5.3))
        sway = Oscillation(
            vector(rng.normal(0, (0.08, 0.03, 0.03))), speed * between(rng, 6, 14), any_angle(rng), centre
        )
        tone = Texture(textures.levels(textures.noise(rng, (64, 64), 0.8), 0.05, between(rng, 0.3, 0.7)))
        bodies.append(Body(f"branch {i}", merged(leaves), RoughPlastic(tone, roughness=0.25), sway))
    return bodies


def water(rng: np.random.Generator, speed: float, photographs: Photographs) -> list[Body]:
    """Return a basin whose waves mirror the sky, the low sun and a facade."""
    surface = moved(sheet(16.0, 9.0, 160, 90), pose_matrix(None, (8.0, 0.0, 0.0)))
    waves = tuple(
        Ripple(height, length, speed * between(rng, 5, 12), float(rng.normal(0, 12)), any_angle(rng))
        for height, length in ((0.12, 1.3), (0.07, 0.6), (0.05, 0.37), (0.03, 0.21))
    )
    lying = exponential((-np.pi / 2, 0, 0))
    flow = Flag(surface.vertices, waves, Still.turned(lying, (-11.0, 0.3, -5.5)))
    basin = Body("water", surface, RoughPlastic(0.03, roughness=0.12, ior=1.33), flow)
    picture = facade_picture(rng, 12, 12)
    far = wall(Texture(picture, (12.0, 2.4)), distance=WALL + 4.0)
    return [basin, far]


def posters(rng: np.random.Generator, speed: float, photographs: Photographs) -> list[Body]:
    """Return a wall with photographs, and posts before it."""
    bodies = [wall(bricks(rng)), ground(asphalt(rng)), *posts(rng)]
    shown = rng.permutation(np.array(photographs))[:3]
    for i, (x, photograph) in enumerate(zip((-1.7, 0.0, 1.7), shown, strict=True)):
        board = moved(box(1.5, 2.0, 0.04, 2.0), pose_matrix(None, (x, between(rng, 1.0, 1.6), -WALL + 0.05)))
        bodies.append(Body(f"poster {i}", board, Diffuse(textures.photograph(str(photograph)))))
    return bodies


def string_of_lamps(rng: np.random.Generator, count: int, z: float) -> list[Body]:
    """Return a row of small bright lamps, tens of times as bright as the street."""
    return [
        Body(
            f"lamp {i}",
            moved(
                ball(between(rng, 0.02, 0.06), 24), pose_matrix(None, (between(rng, -3, 3), between(rng, 1.2, 2.8), z))
            ),
            Glow(between(rng, 5.0, 15.0)),
        )
        for i in range(count)
    ]


def lamps(rng: np.random.Generator, speed: float, photographs: Photographs) -> list[Body]:
    """Return a wet street at night with lamps, lit windows, chrome and a car."""
    house = facade_picture(rng, 12, 12)
    shop = moved(sheet(3.0, 0.8), pose_matrix(None, (between(rng, -1, 1), 1.0, -WALL + 0.05)))
    rail = moved(cylinder(0.04, 6.0, 24), pose_matrix(exponential((0, 0, np.pi / 2)), (0.0, 0.8, -4.0)))
    return [
        wall(Texture(house, (12.0, 2.4))),
        ground(asphalt(rng), gloss=0.08),
        Body("shop window", shop, Glow(between(rng, 0.4, 1.2))),
        Body("rail", rail, Conductor(roughness=0.1)),
        *string_of_lamps(rng, 6, -WALL + 1.5),
        car(rng, speed),
    ]


def car(rng: np.random.Generator, speed: float) -> Body:
    """Return a lacquered car that passes."""
    velocity = speed * sign(rng) * np.array([between(rng, 8.0, 16.0), 0.0, 0.0])
    path = Translation(vector(velocity), vector((0.0, 0.5, -5.0) - velocity * common.CLIP / 2 / speed))
    lower = box(2.2, 0.45, 0.9)
    cabin = moved(box(1.1, 0.4, 0.8), pose_matrix(None, (0.0, 0.42, 0.0)))
    return Body("car", merged([lower, cabin]), RoughPlastic(between(rng, 0.05, 0.5), roughness=0.08), path)


def corner(rng: np.random.Generator, speed: float, photographs: Photographs) -> list[Body]:
    """Return a corner of the street with some of everything."""
    branch = foliage(rng, speed, photographs)[2:5]
    poster = posters(rng, speed, photographs)[-1]
    columns = int(rng.integers(10, 18))
    house = wall(Texture(facade_picture(rng, columns, columns), (12.0, 2.4)))
    paving = ground(Texture(granite_picture(rng), (10.0, 10.0)))
    return [house, paving, *branch, poster, *posts(rng, 2), car(rng, speed)]


# In the order of the last digit of a seed
SUBJECTS: dict[str, Callable[[np.random.Generator, float, Photographs], list[Body]]] = {
    "facade": facade,
    "granite": granite,
    "grass": grass,
    "gravel": gravel,
    "cloth": cloth,
    "foliage": foliage,
    "water": water,
    "posters": posters,
    "lamps": lamps,
    "corner": corner,
}

# In the order of the digits before it
MOTIONS: dict[str, Callable[[np.random.Generator, float], Motion | None]] = {
    "hand": hand,
    "impact": impact,
    "drive": drive,
    "roll": roll,
    "light": at_rest,
    "handled drive": handled_drive,
}
