"""Makes clips of warped pictures: photographs and shapes cut from them that slide, turn and zoom before one another.

    make(WarpedPictures(PICTURES, "out/photos", FILE))  # as `python -m qsim.cli.warped_pictures` does

    pictures -> layers (a background, bodies of random outline) -> relative radiance, exact flow, one clip per number

They cost a thousandth of a rendered clip, and have no shading and no blur. Pictures become linear light and are shrunk
to half of their size at least, which removes most of their noise. Every clip draws its largest motion from 0 to
`motion` px/frame; its layers translate, sway, rotate and zoom up to that. A share of the clips is seen by a camera that
shakes or is struck; a share of the layers repeats a small part, as facades and grids do, and some have bright points. A
pixel is the mean of 3 x 3 bilinear samples; flow follows from the motion in closed form. Clip n is a function of the
pictures, `seed` and n. An existing clip is kept, so the same command resumes; one of other settings is refused. The
folder holds one clip folder per number, and the licences.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy import ndarray as Array
from scipy import ndimage

from qsim import files, limits, opening
from qsim.clip.clip_info import ClipInfo
from qsim.clip.source import Source
from qsim.clip.writer import ClipWriter
from qsim.kinds import Frames, Part, Seed, Split
from qsim.scene.image_files import read_grey
from qsim.scene.textures import noise, pictures_in
from qsim.settings import setting
from qsim.streams.clip import Clip

Motion = Annotated[float, Meta(ge=0.0, le=100.0)]  # px/frame

FINE = 2  # texels of a layer per pixel, at zoom 1
SAMPLES = 3  # per pixel along each side
STILL = 0.15  # share of clips in which nothing moves
FASTEST_GROWTH = 0.05  # of the zoom, per frame
SMOOTH = 0.25  # share of bodies with a smooth tone instead of a picture
SHAKE = 0.4  # of the largest motion, to which a camera shakes
SLOWEST = 0.05  # rad/frame, of the waves of a shaking hand
FASTEST = 1.2  # the same
STRUCK = 0.3  # share of shaking cameras that are struck
RINGING = (0.25, 0.8)  # rad/frame, of a struck camera
LEAST_REPEAT = 2  # px, shortest period of a pattern
MOST_REPEAT = 24  # px, longest
WINDOWS = 0.25  # share of patterns that are a pane in a wall
GRIDS = 0.5  # share of patterns that are stripes or a checkerboard; the others repeat a part of a picture
WIDEST = 8  # px, of a stripe or a square
POINTS = 0.08  # share of layers with bright points
MOST_POINTS = 0.02  # of the pixels of such a layer
BRIGHTEST = 40  # times the mean light of the layer, of a point
STRAIGHT = 0.5  # share of patterns in the background whose rows and columns are those of the picture


@dataclass(frozen=True)
class Path2D:
    """A motion in the picture in closed form; lengths in pixels, times in frames from the middle of the clip."""

    place: tuple[float, float]  # y, x at the middle
    speed: tuple[float, float]  # px/frame
    sway: tuple[float, float]  # px
    frequency: float  # of the sway, rad/frame
    phase: float
    angle: float
    spin: float  # rad/frame
    growth: float  # of the zoom, per frame: zoom = exp(growth time)

    def matrix(self, time: float) -> Array:
        """Return the map [3, 3] of homogeneous (y, x, 1) from layer to picture at a time."""
        wave = np.sin(self.frequency * time + self.phase) - np.sin(self.phase)
        y, x = (p + v * time + a * wave for p, v, a in zip(self.place, self.speed, self.sway, strict=True))
        turn = self.angle + self.spin * time
        zoom = np.exp(self.growth * time)
        c = zoom * np.cos(turn)
        s = zoom * np.sin(turn)
        return np.array([[c, -s, y], [s, c, x], [0, 0, 1]])


@dataclass(frozen=True)
class Wave2D:
    """A swing of the camera about the origin of the picture, which may begin late and die away."""

    size: tuple[float, float, float]  # px down, px right, rad
    frequency: float  # rad/frame
    phase: float = 0.0
    start: float = -np.inf  # frames
    decay: float = 0.0  # per frame, from `start` on

    def shift(self, time: float) -> Array:
        """Return the displacement [3] = (px down, px right, rad) at a time."""
        if time < self.start:
            return np.zeros(3)
        late = time - self.start if self.decay else time
        swing = np.exp(-self.decay * late) * np.sin(self.frequency * late + self.phase)
        return np.array(self.size) * swing


@dataclass(frozen=True)
class Camera2D:
    """A camera that shakes: all layers move alike."""

    waves: tuple[Wave2D, ...] = ()

    def matrix(self, time: float) -> Array:
        """Return the map [3, 3] of homogeneous (y, x, 1) in the picture of a camera at rest to this one."""
        y, x, turn = sum((wave.shift(time) for wave in self.waves), np.zeros(3))
        c = np.cos(turn)
        s = np.sin(turn)
        return np.array([[c, -s, y], [s, c, x], [0, 0, 1]])


@dataclass(frozen=True, eq=False)
class Layer:
    """A picture with its cover, both around the layer's origin, its motion, and the camera that sees it."""

    light: Array  # [h, w], FINE texels per pixel
    cover: Array | None  # [h, w] in 0..1; None: everywhere
    path: Path2D
    camera: Camera2D = Camera2D()

    def matrix(self, time: float) -> Array:
        """Return the map [3, 3] of homogeneous (y, x, 1) from layer to picture at a time."""
        found: Array = self.camera.matrix(time) @ self.path.matrix(time)
        return found

    def sampled(self, points: Array, time: float) -> tuple[Array, Array]:
        """Return light and cover at picture points (y, x) [2, n] at a time."""
        inverse = np.linalg.inv(self.matrix(time))
        at = FINE * (inverse[:2, :2] @ points + inverse[:2, 2:])
        at += np.array([[n / 2 - 0.5] for n in self.light.shape])
        light = ndimage.map_coordinates(self.light, at, order=1, mode="mirror")
        if self.cover is None:
            return light, np.ones_like(light)
        return light, ndimage.map_coordinates(self.cover, at, order=1, mode="constant")


def layers(
    pictures: Sequence[Array],
    size: tuple[int, int],
    motion: float,
    rng: np.random.Generator,
    *,
    shake: float = 0.0,
    patterns: float = 0.0,
) -> list[Layer]:
    """Return a background and zero to four bodies before it.

    `pictures` are linear light [h, w]; `size` is that of the clip [px], `motion` its largest speed [px/frame]. The
    camera shakes with the probability `shake`, and a layer is a pattern with the probability `patterns`.
    """
    largest = 0.0 if rng.random() < STILL else motion * rng.random()
    side = max(size)
    camera = Camera2D()
    if rng.random() < shake:
        camera = _shaking(SHAKE * motion * rng.random(), side, rng)
        largest *= 0.5 * rng.random()  # by itself; shake comes on top

    def light_of(across: int) -> tuple[Array, bool]:
        repeats = rng.random() < patterns
        light = _pattern(pictures, across, rng) if repeats else _cut(pictures, across, rng)
        return _with_points(light, rng) if rng.random() < POINTS else light, repeats

    behind, repeats = light_of(2 * side)
    path = _path(size, largest, side, rng)
    if repeats and rng.random() < STRAIGHT:
        path = _straight(path)
    found = [Layer(behind, None, path, camera)]
    for _ in range(int(rng.integers(0, 5))):
        across = int(side * rng.uniform(0.15, 0.7))
        light = _tone(across, rng) if rng.random() < SMOOTH else light_of(across)[0]
        own = largest * rng.choice([0.0, 0.5, 1.0], p=[0.2, 0.3, 0.5])
        found.append(Layer(light, _outline(light.shape, rng), _path(size, own, across / 2, rng), camera))
    return found


def frame(parts: Sequence[Layer], size: tuple[int, int], time: float) -> tuple[Array, Array, Array]:
    """Return light [H, W], flow to one frame later [2, H, W] (x, y) [px], and where the point is seen there [H, W]."""
    height, width = size
    steps = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    y, x = np.mgrid[:height, :width].astype(float)
    total = np.zeros((height, width))
    for dy in steps:
        for dx in steps:
            total += _seen(parts, np.stack([y.ravel() + dy, x.ravel() + dx]), time)[0].reshape(size)
    points = np.stack([y.ravel(), x.ravel()])
    top = _seen(parts, points, time)[1]
    moved = points.copy()
    for i, layer in enumerate(parts):
        # From the picture back to the layer, and from there to where its point is one frame later.
        step = layer.matrix(time + 1) @ np.linalg.inv(layer.matrix(time))
        own = top == i
        moved[:, own] = step[:2, :2] @ points[:, own] + step[:2, 2:]
    inside = (moved >= 0).all(0) & (moved[0] <= height - 1) & (moved[1] <= width - 1)
    # A point is seen again where the same layer is uppermost at its new place.
    valid = inside & (_seen(parts, moved, time + 1)[1] == top)
    flow = (moved - points)[::-1].reshape(2, *size)
    return total / SAMPLES**2, flow.astype(np.float32), valid.reshape(size)


def _seen(parts: Sequence[Layer], points: Array, time: float) -> tuple[Array, Array]:
    """Return the light and the uppermost layer that covers more than half, at points (y, x) [2, n]."""
    light = np.zeros(points.shape[1])
    top = np.zeros(points.shape[1], int)
    for i, layer in enumerate(parts):
        own, cover = layer.sampled(points, time)
        light += cover * (own - light)
        top[cover > 0.5] = i
    return light, top


def _path(size: tuple[int, int], largest: float, radius: float, rng: np.random.Generator) -> Path2D:
    """Return a random motion of at most about `largest` px/frame for points up to `radius` px from its centre."""
    shares = rng.dirichlet((3.0, 1.0, 0.7, 0.7)) * largest  # of translation, sway, rotation and zoom
    angle = rng.uniform(0, 2 * np.pi)
    frequency = rng.uniform(0.2, 0.6)
    side = rng.uniform(0, 2 * np.pi)
    # So that the largest speed of the sway, amplitude times frequency, is its share.
    sway = shares[1] / frequency
    return Path2D(
        place=(float(rng.uniform(0, size[0])), float(rng.uniform(0, size[1]))),
        speed=(float(shares[0] * np.sin(angle)), float(shares[0] * np.cos(angle))),
        sway=(float(sway * np.sin(side)), float(sway * np.cos(side))),
        frequency=float(frequency),
        phase=float(rng.uniform(0, 2 * np.pi)),
        angle=float(rng.uniform(0, 2 * np.pi)),
        spin=float(shares[2] / radius * rng.choice([-1, 1])),
        growth=float(min(shares[3] / radius, FASTEST_GROWTH) * rng.choice([-1, 1])),
    )


def _straight(path: Path2D) -> Path2D:
    """Return a path without turn and zoom, on which edges of texels are edges of pixels in the middle of the clip."""
    y, x = (float(round(p)) for p in path.place)
    quarter = np.pi / 2 * round(path.angle / (np.pi / 2))
    return replace(path, place=(y, x), angle=quarter, spin=0.0, growth=0.0)


def _shaking(largest: float, side: float, rng: np.random.Generator) -> Camera2D:
    """Return a camera that moves points up to `side` px from the origin by at most about `largest` px/frame."""
    if rng.random() < STRUCK:
        axis = rng.normal(0, (1.0, 1.0, 0.3 / side))
        frequency = rng.uniform(*RINGING)
        size = axis / np.hypot(*axis[:2]) * largest / frequency
        decay = rng.uniform(0.03, 0.2)
        return Camera2D((Wave2D(_three(size), float(frequency), 0.0, float(rng.uniform(-8, 4)), float(decay)),))
    # Slow waves are large and fast ones small: each has its share of the speed.
    shares = rng.dirichlet((1.0,) * 6) * largest
    waves = []
    for share in shares:
        angle = rng.uniform(0, 2 * np.pi)
        frequency = np.exp(rng.uniform(np.log(SLOWEST), np.log(FASTEST)))
        turn = rng.normal(0, 0.3) / side
        size = np.array([np.sin(angle), np.cos(angle), turn]) * share / frequency
        waves.append(Wave2D(_three(size), float(frequency), float(rng.uniform(0, 2 * np.pi))))
    return Camera2D(tuple(waves))


def _three(values: Array) -> tuple[float, float, float]:
    y, x, turn = (float(value) for value in values)
    return y, x, turn


def _pattern(pictures: Sequence[Array], across: int, rng: np.random.Generator) -> Array:
    """Return a square of `across` px in which a small part repeats: of a picture, a pane in a wall, or a grid."""
    kind = rng.random()
    if kind < GRIDS:
        return _tiled(_grid(rng), FINE * across)
    rows, columns = (round(FINE * np.exp(rng.uniform(np.log(LEAST_REPEAT), np.log(MOST_REPEAT)))) for _ in range(2))
    if kind < GRIDS + WINDOWS:
        wall, pane = np.exp(rng.uniform(np.log(0.02), np.log(0.9), 2))
        part = np.full((rows, columns), wall)
        part[: max(1, int(rows * rng.uniform(0.3, 1.0))), : max(1, int(columns * rng.uniform(0.3, 1.0)))] = pane
    else:
        part = _cut(pictures, max(rows, columns), rng)[:rows, :columns]
    return _tiled(part, FINE * across)


def _tiled(part: Array, side: int) -> Array:
    """Return a square of `side` texels that repeats a part."""
    repeats = [-(-side // n) for n in part.shape]
    return np.tile(part, repeats)[:side, :side]


def _grid(rng: np.random.Generator) -> Array:
    """Return a period of stripes along rows or columns, or of a checkerboard, of two tones and 1 to WIDEST px."""
    width = FINE * round(np.exp(rng.uniform(0, np.log(WIDEST))))
    dark = np.exp(rng.uniform(np.log(0.005), np.log(0.5)))
    bright = dark + rng.uniform(0.2, 1.0) * (1 - dark)
    y, x = np.mgrid[: 2 * width, : 2 * width] // width
    odd = (y % 2, x % 2, (y + x) % 2)[int(rng.integers(3))]
    return np.where(odd == 1, bright, dark)


def _with_points(light: Array, rng: np.random.Generator) -> Array:
    """Return light [h, w] with bright points of one pixel, as sparks and distant lamps are."""
    sides = [n // FINE for n in light.shape]
    share = np.exp(rng.uniform(np.log(MOST_POINTS / 100), np.log(MOST_POINTS)))
    strength = rng.uniform(1, BRIGHTEST) * rng.uniform(0.3, 1.0, sides) * light.mean()
    points = np.where(rng.random(sides) < share, strength, 0.0)
    added: Array = light.copy()
    added[: FINE * sides[0], : FINE * sides[1]] += points.repeat(FINE, 0).repeat(FINE, 1)
    return added


def _cut(pictures: Sequence[Array], across: int, rng: np.random.Generator) -> Array:
    """Return a square of `across` px from a random picture, in a random exposure.

    In half of the cases it is the one of most texture among six: large parts of photographs are out of focus.
    """
    found = [_square(pictures, across, rng) for _ in range(6 if rng.random() < 0.5 else 1)]
    part = max(found, key=lambda cut: float(np.abs(np.diff(cut, axis=0)).mean() / (cut.mean() + 0.01)))
    part = np.rot90(part, int(rng.integers(4)))
    part = part if rng.random() < 0.5 else part[:, ::-1]
    return np.ascontiguousarray(part) * np.exp(rng.normal(0, 0.5)) + 0.02 * rng.random()


def _square(pictures: Sequence[Array], across: int, rng: np.random.Generator) -> Array:
    """Return a random square of `across` px, or as much as there is, of a random picture."""
    picture = pictures[int(rng.integers(len(pictures)))]
    side = min(FINE * across, *picture.shape)
    y, x = (int(rng.integers(n - side + 1)) for n in picture.shape)
    return picture[y : y + side, x : x + side]


def _tone(across: int, rng: np.random.Generator) -> Array:
    """Return a smooth tone with a slight slope, [n, n] texels."""
    y, x = (np.mgrid[: FINE * across, : FINE * across] + 0.5) / (FINE * across) - 0.5
    slope = rng.normal(0, 0.3, 2)
    return np.exp(rng.uniform(np.log(0.02), np.log(0.9)) + slope[0] * y + slope[1] * x)


def _outline(shape: tuple[int, ...], rng: np.random.Generator) -> Array:
    """Return the cover [h, w] of a body: a wavy disk, a bar, or blobs; 0 at its border, with edges one texel soft."""
    height, width = shape
    y, x = (np.mgrid[:height, :width] + 0.5) / np.array([height, width])[:, None, None] * 2 - 1
    match rng.integers(4):
        case 0:
            angle = np.arctan2(y, x)
            waves = sum(rng.normal(0, 0.1) * np.cos(k * angle + rng.uniform(0, 2 * np.pi)) for k in range(2, 8))
            inside = 0.7 * (1 + waves) - np.hypot(y, x)
        case 1:
            inside = np.minimum(0.95 - np.abs(x), rng.uniform(0.04, 0.4) - np.abs(y))
        case 2:
            inside = np.minimum(0.9 - np.abs(x), 0.9 - np.abs(y))
        case _:
            blobs = noise(rng, (height, width), 2.0)
            inside = np.minimum(blobs - np.quantile(blobs, rng.uniform(0.3, 0.7)), 0.95 - np.maximum(abs(x), abs(y)))
    return np.clip(inside * height / 2 + 0.5, 0, 1)


def read_pictures(paths: Sequence[Path], smallest: int) -> list[Array]:
    """Return pictures as linear light [h, w], shrunk to half or less; `ValueError` for one smaller than `smallest`."""
    found = []
    for path in paths:
        light = read_grey(path)
        shrink = max(2, min(light.shape) // 1200)
        height, width = (n // shrink * shrink for n in light.shape)
        light = light[:height, :width].reshape(height // shrink, shrink, width // shrink, shrink).mean((1, 3))
        if min(light.shape) < smallest:
            raise ValueError(
                f"{path}: {width} x {height} px, half of which is less than {smallest} px; leave this picture out, or "
                "choose smaller clips"
            )
        found.append(light.astype(np.float64))
    return found


def write_clip(path: Path, parts: Sequence[Layer], size: tuple[int, int], info: ClipInfo) -> Clip:
    """Write one clip of `info.shape[0]` frames; an interrupted one resumes."""
    frames = info.shape[0]
    with ClipWriter(path, info) as writer:
        for t in range(frames):
            if not writer.has(t):
                light, flow, valid = frame(parts, size, t - (frames - 1) / 2)
                writer.add(t, light.astype(np.float32), truth={"flow": flow, "valid": valid})
    return Clip.open(path)


@dataclass(frozen=True)
class WarpedPictures:
    """The clips that are made, and of which pictures."""

    pictures: Annotated[Path, setting("folder of pictures (.jpg, .png, .tif), sRGB", positional=True)]
    output: Annotated[Path, setting("folder of the clips", short="o")]
    licence: Annotated[Path, setting("file with the pictures' licence; it is copied")]
    clips: Annotated[Frames, setting("number of clips")] = 300
    first: Annotated[Seed, setting("number of the first clip")] = 0
    frames: Annotated[Frames, setting("frames of a clip")] = 16
    height: Annotated[Frames, setting("pixels")] = 112
    width: Annotated[Frames, setting("pixels")] = 112
    motion: Annotated[Motion, setting("largest motion, px/frame")] = 16.0
    shake: Annotated[Part, setting("share of clips under a shaking camera")] = 0.4
    patterns: Annotated[Part, setting("share of layers that repeat a small part")] = 0.2
    split: Annotated[Split, setting("stored in the clips")] = "train"
    seed: Annotated[Seed, setting("of everything random")] = 0

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns of a frame [px]."""
        return self.height, self.width

    @property
    def places(self) -> dict[int, Path]:
        """The folder of each clip, by its number."""
        return {n: self.output / f"warped_{n:05d}" for n in range(self.first, self.first + self.clips)}


def make(asked: WarpedPictures) -> int:
    """Write the missing clips, and return their number; `ValueError` for a clip of other settings."""
    size = asked.size
    folder = asked.output
    licence = asked.licence
    paths = pictures_in(asked.pictures)
    lights = read_pictures(paths, max(size))
    if not licence.is_file():
        raise FileNotFoundError(f"{licence}: no such file; name the file that states the licence of the pictures")
    digests = [f"texture {files.sha256(path, limits.ASSET)}" for path in paths]
    missing = {n: path for n, path in asked.places.items() if not path.exists()}
    for n, path in asked.places.items():
        if n not in missing:
            _check_same(path, _described(n, digests, asked))
    folder.mkdir(parents=True, exist_ok=True)
    _copy_licence(licence, folder)
    for n, path in missing.items():
        rng = np.random.default_rng([asked.seed, n])
        parts = layers(lights, size, asked.motion, rng, shake=asked.shake, patterns=asked.patterns)
        write_clip(path, parts, size, _described(n, digests, asked))
    return len(missing)


def _described(n: int, digests: list[str], asked: WarpedPictures) -> ClipInfo:
    """Return the description of clip n, without what its writer measures."""
    return ClipInfo(
        shape=(asked.frames, asked.height, asked.width),
        frame_rate=2000.0,
        exposure=1 / 2000.0,
        split=asked.split,
        assets=tuple(digests),
        source=Source(
            format="warped pictures",
            seed=asked.seed,
            number=n,
            motion=asked.motion,
            shake=asked.shake,
            patterns=asked.patterns,
        ),
    )


def _check_same(path: Path, wanted: ClipInfo) -> None:
    """Raise `ValueError` if a clip has another size, other pictures, another seed or motion; its split may differ."""
    there = Clip.open(path).info
    for key, what in (("shape", "size"), ("assets", "set of pictures"), ("source", "seed, motion, shake or patterns")):
        if getattr(there, key) != getattr(wanted, key):
            raise ValueError(f"{path}: was made with another {what}; name another folder, or another first=")


def _copy_licence(licence: Path, folder: Path) -> None:
    """Copy a licence as LICENCE.txt; another one that is there stays, and this one is named by its checksum."""
    text = opening.content(licence)
    copy = folder / "LICENCE.txt"
    if copy.is_file() and opening.content(copy) != text:
        copy = folder / f"LICENCE-{files.sha256(text)[:8]}.txt"
    files.write_bytes(copy, text)
