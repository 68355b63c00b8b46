"""Sees frames along paths p + k v + k^2/2 a, and means of squares of pixels, for batches of windows on any device.

Fields are [B, 2, H, W] = (down, right), in pixels of the full frame per frame, at cells of one scale. Several fields of
the same frames may lie below each other: [B, 2, C * H, W].
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import torch
import torch.nn.functional as functional
from torch import Tensor

from quiver.device import is_gpu

SCALES = (8, 4, 2)  # px of the full frame per cell, along one side
CHUNK = 1 << 20  # cells that are followed at a time on a CPU, whose cache then holds them
CUBIC = -0.75  # slope of the cubic kernel one pixel from its middle (Keys 1981), that of torch's sampling

Path = tuple[Tensor, Tensor]  # velocity and acceleration [B, 2, h, w]


def box_mean(image: Tensor, radius: int) -> Tensor:
    """Return means of squares of 2 radius + 1 pixels of [..., H, W]; beyond the border the last pixel repeats."""
    side = 2 * radius + 1
    height, width = image.shape[-2:]
    grown = functional.pad(image.reshape(-1, 1, height, width), (radius,) * 4, mode="replicate")
    return _sums(_sums(grown, side, 3), side, 2).div_(side**2).view(image.shape)


def smooth_mean(image: Tensor, radius: int) -> Tensor:
    """Return box means of box means [..., H, W]. No wave is turned into its negative, as one box mean does: corrections
    that are averaged so converge.
    """
    return box_mean(box_mean(image, radius), radius)


def _sums(x: Tensor, count: int, dim: int) -> Tensor:
    """Return sums of `count` neighbours along one axis, by sums of 1, 2, 4, ... neighbours."""
    length = x.shape[dim] - count + 1
    place = 0
    width = 1
    rest = count
    total: Tensor | None = None
    while True:
        if rest & 1:
            part = x.narrow(dim, place, length)
            total = part if total is None else total + part
            place += width
        rest >>= 1
        if not rest:
            assert total is not None
            return total
        x = x.narrow(dim, 0, x.shape[dim] - width) + x.narrow(dim, width, x.shape[dim] - width)
        width *= 2


def kept_noise(moved: Tensor) -> Tensor:
    """Return the share of the noise's variance [..., H, W] that is left at p + moved [..., 2, H, W], seen by `look`."""
    part = moved - moved.floor()
    # The sum of squared bilinear weights: between pixels a mean of two has half of the noise.
    share = part.square()
    share += part.neg_().add_(1).square_()
    return share.select(-3, 0) * share.select(-3, 1)


def kept_noise_of_cubic(moved: Tensor) -> Tensor:
    """Return the share of the noise's variance [..., H, W] that is left at p + moved [..., 2, H, W], seen by
    `look_sharply`.

    With t the place between two pixels and u = t (1 - t), the four weights of the kernel are A u (1 - t) and A u t
    outside; those inside have the sum S = 1 - A u and the difference D = (1 - 2t) (1 + (A + 2) u). The sum of their
    squares, A^2 u^2 (1 - 2u) + (S^2 + D^2) / 2, has the coefficients below in u^2 and u^3; that of u is 0.
    """
    between = moved - moved.floor()
    between = between.mul(1 - between)
    share = (between * _CUBED).add_(_SQUARED).mul_(between.square_()).add_(1)
    return share.select(-3, 0) * share.select(-3, 1)


_B = CUBIC + 2
_SQUARED = CUBIC**2 * 1.5 + _B**2 / 2 - 4 * _B
_CUBED = -2 * CUBIC**2 - 2 * _B**2


def look(
    frames: Tensor,
    path: Path,
    offsets: Sequence[int],
    scale: int = 1,
    size: tuple[int, int] | None = None,
    camera: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Return frames [B, K, h, w] seen where paths [B, 2, C * h, w] lead after `offsets`, [B, K, C * h, w], bilinear,
    and 1 where that lies inside, else 0.

    Inside are the first rows and columns, `size` of them, of frames that were filled; None: all. A `camera` moves what
    the paths reach: motion [B, K, 2, 3] of camera_motion.py.
    """
    seen, inside, _ = _looked(frames, path, offsets, scale, size, camera, None)
    return seen, inside


def look_with_noise(
    frames: Tensor, path: Path, offsets: Sequence[int], scale: int, camera: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Return what `look` does, and the share of the noise's variance that is left there, [B, K, C * h, w]."""
    seen, inside, kept = _looked(frames, path, offsets, scale, None, camera, kept_noise)
    assert kept is not None
    return seen, inside, kept


def look_sharply(
    frames: Tensor, path: Path, offsets: Sequence[int], size: tuple[int, int], camera: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return what `look` does at full size, by cubics, and the share of the noise's variance that is left there.

    Half a pixel beyond the middle of the last pixel a place is seen as that pixel alone, with all of its noise.
    """
    seen, inside, kept = _looked(frames, path, offsets, 1, size, camera, kept_noise_of_cubic, "bicubic")
    assert kept is not None
    return seen, inside, kept


def look_still(frames: Tensor) -> Tensor:
    """Return frames [B, K, h, w] as `look` sees them without motion, by one grid for all."""
    batch, _, height, width = frames.shape
    first, unit = _lattice(height, width, height, frames.device)
    grid = (first * unit).sub_(1).permute(1, 2, 0).expand(batch, -1, -1, -1)
    return functional.grid_sample(frames, grid, padding_mode="border", align_corners=True)


def _looked(
    frames: Tensor,
    path: Path,
    offsets: Sequence[int],
    scale: int,
    size: tuple[int, int] | None,
    camera: Tensor | None,
    kept: Callable[[Tensor], Tensor] | None,
    mode: str = "bilinear",
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Return what `look` does with this interpolation, and what `kept` says of the places, None without it."""
    batch, count, height, width = frames.shape
    velocity, acceleration = (field.flip(1)[:, None] / scale for field in path)  # (right, down), as grids have it
    rows = velocity.shape[-2]
    first, unit = _lattice(height, width, rows, frames.device)
    last = [side - 1 for side in size or (height, width)]
    times = powers(tuple(offsets), frames.device)
    cells = batch * rows * width
    step = count if is_gpu(frames.device) else max(1, min(count, CHUNK // cells))
    found: list[list[Tensor]] = [[], [], []]
    for start in range(0, count, step):
        part = slice(start, start + step)
        place = velocity * times[0, part]
        place += acceleration * times[1, part]
        place += first
        if camera is not None:
            place = _led(camera[:, part] / scale, place)
        if kept is not None:
            found[2].append(kept(_inside(place, last)))
        found[1].append(_within(place[:, :, 0], last[1]).mul_(_within(place[:, :, 1], last[0])))
        grid = place.mul_(unit).sub_(1).flatten(0, 1).permute(0, 2, 3, 1)
        images = frames[:, part].reshape(-1, 1, height, width)
        seen = functional.grid_sample(images, grid, mode=mode, padding_mode="border", align_corners=True)
        found[0].append(seen.view(batch, -1, rows, width))
    seen, inside = (_joined(parts) for parts in found[:2])
    return seen, inside, _joined(found[2]) if found[2] else None


def _led(camera: Tensor, place: Tensor) -> Tensor:
    """Return where a camera's motion [B, K, 2, 3] in cells leads from places [B, K, 2, h, w] = (right, down).

    Motion is by (1, y, x) from -1 to 1 across the frame: an affine map of the places.
    """
    height, width = place.shape[-2:]
    right, down = place.unbind(2)
    moved = []
    for own, motion in ((right, camera[:, :, 1]), (down, camera[:, :, 0])):
        shift = motion[..., 0] + motion[..., 1] * (1 / height - 1) + motion[..., 2] * (1 / width - 1)
        of_down = motion[..., 1] * (2 / height)
        of_right = motion[..., 2] * (2 / width)
        led = own + shift[..., None, None]
        moved.append(led.addcmul_(down, of_down[..., None, None]).addcmul_(right, of_right[..., None, None]))
    return torch.stack(moved, dim=2)


def _joined(parts: list[Tensor]) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(parts, dim=1)


@lru_cache(maxsize=64)
def powers(offsets: tuple[int, ...], device: torch.device) -> Tensor:
    """Return k and k^2/2 of offsets k, [2, K, 1, 1, 1]."""
    found = torch.tensor([list(offsets), [k * k / 2 for k in offsets]], dtype=torch.float32)
    return found[..., None, None, None].to(device)


@lru_cache(maxsize=64)
def _lattice(height: int, width: int, rows: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the places [2, rows, w] = (right, down) of cells, and the units of a grid, [2, 1, 1]."""
    down = torch.arange(rows, device=device).remainder(height).to(torch.float32)
    right = torch.arange(width, device=device, dtype=torch.float32)
    places = torch.stack([right.expand(rows, width), down[:, None].expand(rows, width)])
    unit = torch.tensor([2 / max(width - 1, 1), 2 / max(height - 1, 1)], dtype=torch.float32)[:, None, None]
    return places, unit.to(device)


def _within(place: Tensor, last: int) -> Tensor:
    """Return 1 where a place lies within half a cell of 0 to `last`, else 0.

    Floats: a truth value takes five times as long.
    """
    return place.clamp(-0.5, last + 0.5).eq_(place)


def _inside(place: Tensor, last: Sequence[int]) -> Tensor:
    """Return places [B, K, 2, h, w] = (right, down) that are moved to the last cells where they lie beyond them."""
    right, down = place.unbind(2)
    return torch.stack([right.clamp(0, last[1]), down.clamp(0, last[0])], dim=2)


def halved(image: Tensor) -> Tensor:
    """Return means of 2 x 2 pixels of [..., H, W]; several times as fast as `avg_pool2d` on a CPU."""
    columns = image[..., 0::2] + image[..., 1::2]
    return (columns[..., 0::2, :] + columns[..., 1::2, :]).mul_(0.25)


def enlarged(field: Tensor, shape: Sequence[int]) -> Tensor:
    """Return a field [B, N, h, w] at another scale."""
    return functional.interpolate(field, size=tuple(shape), mode="bilinear", align_corners=False)
