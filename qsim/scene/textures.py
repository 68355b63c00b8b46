"""Makes pictures [H, W] of linear reflectance from a random generator, patterns, text or photographs.

Procedural pictures tile without a seam. Values lie in 0..1. `levels` stretches them to a range, because surfaces darker
than 2 % or brighter than 95 % are rare. The photographs are files of the scikit-image package; nothing is downloaded.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from qsim.scene.materials import Texture

Picture = NDArray[np.float32]

PHOTOGRAPHS = {  # name -> file in the scikit-image wheel; all are CC0 or public domain by its own documentation
    "astronaut": "astronaut.png",
    "brick": "brick.png",
    "camera": "camera.png",
    "cat": "chelsea.png",
    "coffee": "coffee.png",
    "coins": "coins.png",
    "galaxies": "hubble_deep_field.jpg",
    "grass": "grass.png",
    "gravel": "gravel.png",
    "moon": "moon.png",
    "page": "page.png",
    "rocket": "rocket.jpg",
}
PICTURE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp"})


def levels(picture: NDArray[np.floating], low: float = 0.1, high: float = 0.8, contrast: float = 1.0) -> Picture:
    """Stretch the 1st and 99th percentiles to `low` and `high`; `contrast` > 1 favours the ends."""
    if not 0 <= low <= high <= 1:
        raise ValueError(f"levels: expected 0 <= low <= high <= 1, got {low!r} and {high!r}")
    dark, bright = np.percentile(picture, [1, 99])
    scaled = np.clip((picture - dark) / max(bright - dark, 1e-12), 0, 1)
    if contrast != 1.0:
        a = scaled**contrast
        b = (1 - scaled) ** contrast
        scaled = a / (a + b)
    return (low + (high - low) * scaled).astype(np.float32)


def photograph(name: str, low: float = 0.03, high: float = 0.85, repeat: tuple[float, float] = (1.0, 1.0)) -> Texture:
    """Return one of `PHOTOGRAPHS` as linear luminance, stretched to `low` .. `high`; `ValueError` for other names.

    The texture names its source, so that a data set finds the same photograph in two splits.
    """
    if name not in PHOTOGRAPHS:
        raise ValueError(f"photograph {name!r} is not one of {', '.join(sorted(PHOTOGRAPHS))}")
    import skimage

    pixels = Texture(str(Path(skimage.__file__).parent / "data" / PHOTOGRAPHS[name])).pixels()
    return Texture(levels(pixels, low, high), repeat, source=name)


def pictures_in(folder: str | Path) -> list[Path]:
    """Return the image files of a folder, sorted by name; `FileNotFoundError` if there are none."""
    found = sorted(p for p in Path(folder).glob("*") if p.suffix.lower() in PICTURE_SUFFIXES)
    if not found:
        raise FileNotFoundError(f"{folder}: no image files ({', '.join(sorted(PICTURE_SUFFIXES))}) in this folder")
    return found


def noise(
    rng: np.random.Generator, size: tuple[int, int] = (512, 512), slope: float = 1.0, cut: float = 0.0
) -> Picture:
    """Return fractal noise: Gaussian with a power spectrum f^(-2 slope), rescaled to 0..1; it tiles.

    `slope` 1 resembles clouds, 0.5 sand, 1.5 marble. Frequencies below `cut` [per picture] are left out.
    """
    fy = np.fft.fftfreq(size[0])[:, None] * size[0]
    fx = np.fft.rfftfreq(size[1])[None, :] * size[1]
    frequency = np.hypot(fy, fx)
    frequency[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.standard_normal(size)) * np.where(frequency >= cut, frequency**-slope, 0)
    return levels(np.fft.irfft2(spectrum, s=size), 0, 1)


def checker(columns: int = 8, rows: int = 8, low: float = 0.1, high: float = 0.8, cell: int = 32) -> Picture:
    """Return a chess board of `columns` x `rows` fields; even numbers tile."""
    y, x = np.mgrid[: rows * cell, : columns * cell] // cell
    return np.where((x + y) % 2 == 0, high, low).astype(np.float32)


def stripes(count: int = 16, low: float = 0.1, high: float = 0.8, size: int = 512, duty: float = 0.5) -> Picture:
    """Return `count` vertical stripes, a fraction `duty` of each period bright, with edges one texel soft."""
    phase = (np.arange(size) + 0.5) * count / size % 1.0
    edge = 0.5 + (duty / 2 - np.abs(phase - 0.5)) * size / count
    row = low + (high - low) * np.clip(edge, 0, 1)
    return np.repeat(row[None, :], size, axis=0).astype(np.float32)


def dots(count: int = 12, low: float = 0.1, high: float = 0.8, size: int = 512, radius: float = 0.3) -> Picture:
    """Return a square lattice of `count` x `count` bright disks of `radius` periods."""
    place = ((np.arange(size) + 0.5) * count / size) % 1.0 - 0.5
    distance = np.hypot(place[:, None], place[None, :])
    return (low + (high - low) * np.clip(0.5 + (radius - distance) * size / count, 0, 1)).astype(np.float32)


def rings(rng: np.random.Generator, count: float = 14.0, size: int = 512, wobble: float = 0.6) -> Picture:
    """Return wood in 0..1: `count` rings around the left edge's middle, bent by `wobble` periods; it does not tile."""
    y, x = (np.mgrid[:size, :size] + 0.5) / size
    bend = wobble * (noise(rng, (size, size), 1.6) - 0.5) * 6
    phase = count * np.hypot(x, (y - 0.5) * 0.35) + bend
    grain = noise(rng, (size, size), 0.7)
    return levels(phase % 1.0 + 0.35 * grain, 0, 1)


def bricks(rng: np.random.Generator, rows: int = 12, columns: int = 6, size: int = 768, joint: float = 0.08) -> Picture:
    """Return a wall in running bond: rough bricks of different greys, bright joints; it tiles for even `rows`."""
    y, x = (np.mgrid[:size, :size] + 0.5) / size
    row = np.floor(y * rows).astype(int)
    shifted = (x * columns + 0.5 * (row % 2)) % columns
    column = np.floor(shifted).astype(int)
    tone = rng.uniform(0.25, 0.6, (rows, columns))[row, column]
    from_joint = np.minimum(
        _to_edge(y * rows % 1.0), _to_edge(shifted % 1.0) * rows / columns * 0.5
    )  # in brick heights: a brick is about twice as long as high
    face = np.clip((from_joint - joint / 2) / 0.04, 0, 1)
    rough = noise(rng, (size, size), 0.8)
    return np.clip(face * tone * (0.7 + 0.6 * rough) + (1 - face) * (0.65 + 0.2 * rough), 0.02, 0.95).astype(np.float32)


def cells(rng: np.random.Generator, count: int = 120, size: int = 512, joint: float = 0.12) -> Picture:
    """Return paving in 0..1: Voronoi cells of different greys with dark joints; it tiles."""
    from scipy.spatial import cKDTree

    seeds = rng.random((count, 2))
    y, x = (np.mgrid[:size, :size] + 0.5) / size
    distance, index = cKDTree(seeds, boxsize=1.0).query(np.stack([y, x], -1), k=2)
    # The distances to the two nearest seeds are equal on the edge between cells.
    gap = (distance[..., 1] - distance[..., 0]) * np.sqrt(count)
    face = np.clip((gap - joint / 2) / 0.06, 0, 1)
    tone = rng.uniform(0.3, 0.95, count)[index[..., 0]] * (0.8 + 0.3 * noise(rng, (size, size), 0.8))
    return np.clip(0.06 + face * tone, 0, 1).astype(np.float32)


def speckles(rng: np.random.Generator, count: int = 1500, size: int = 512, largest: float = 0.02) -> Picture:
    """Return terrazzo in 0..1: dots of random greys and sizes (fractions of the picture) on a ground; it tiles."""
    picture = np.full((size, size), 0.75, np.float32) + 0.1 * (noise(rng, (size, size), 0.6) - 0.5)
    places = rng.random((count, 2)) * size
    radii = size * largest * rng.beta(1, 4, count) + 0.7
    for (cy, cx), radius, tone in zip(places, radii, rng.uniform(0, 1, count), strict=True):
        reach = int(np.ceil(radius)) + 1
        iy, ix = (np.arange(int(c) - reach, int(c) + reach + 1) for c in (cy, cx))
        cover = np.clip(radius + 0.5 - np.hypot((iy + 0.5 - cy)[:, None], (ix + 0.5 - cx)[None, :]), 0, 1)
        at = np.ix_(iy % size, ix % size)
        picture[at] += cover * (tone - picture[at])
    return picture


def lines_of_text(
    lines: Sequence[str], width: int = 1024, height: int = 512, ink: float = 0.05, paper: float = 0.8
) -> Picture:
    """Return a printed page: every line fills the width, and an empty line is 0.4 pages high.

    The font is matplotlib's bold DejaVu Sans.
    """
    import matplotlib as mpl
    from PIL import Image, ImageDraw, ImageFont

    font = str(Path(mpl.get_data_path()) / "fonts" / "ttf" / "DejaVuSans-Bold.ttf")
    page = Image.new("L", (width, height), 0)
    draw = ImageDraw.Draw(page)
    top = 0.04 * height
    margin = 0.05 * width
    for line in lines:
        if not line:
            top += 0.4 * height
            continue
        wide = ImageFont.truetype(font, 100).getlength(line) / 100
        size = (width - 2 * margin) / wide
        draw.text((margin, top), line, fill=255, font=ImageFont.truetype(font, size))
        top += 1.15 * size
    cover = np.asarray(page, np.float32) / 255
    return (paper + (ink - paper) * cover).astype(np.float32)


def _to_edge(phase: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the distance of a phase in 0..1 to the nearer end."""
    return np.minimum(phase, 1 - phase)
