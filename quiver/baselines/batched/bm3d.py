"""Removes white noise from a batch of images by BM3D on any device, in steps whose shapes no image changes.

    images [B, H, W] -> table of DCT blocks [B, rows, columns, 64] -> per tile: distances as one matrix product, top of
    each window -> stacks gathered, Haar as matrix products, filtered, added at their positions -> fold -> [B, H, W]

It computes what quiver/baselines/bm3d.py does; its head has the method. On a CPU stacks of one size are filtered
together, and pixels outside are left out. Here all stacks have the same length: shorter ones carry zeros, which their
Haar matrices make, and blocks outside of the image weigh nothing. So nothing depends on values, and nothing waits.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
import torch.nn.functional as functional
from torch import Tensor

from quiver.baselines import bm3d
from quiver.baselines.bm3d import AREA, BLOCK, FAR, RADIUS, REACH, STEP, TILE, Profile

SIDE = 2 * RADIUS + 1  # positions per side of a search window
TILE_BYTES = 6_000_000  # that a tile takes: distances of its 64 blocks, then their stacks of at most 32
NORMAL = Profile()
PIXEL_BYTES = 2500  # that a pixel takes: tables of blocks and sums of both steps


def denoise(
    images: Tensor, sigma: float, *, peak: float = 1.0, memory: float = np.inf, profile: Profile = NORMAL
) -> Tensor:
    """Return images float32 [B, H, W] without their white noise of deviation `sigma`, in the same unit, where they are.

    `peak` is the image value that stands for 255 grey levels. Tiles are computed together as far as about `memory`
    bytes hold them.
    """
    if sigma == 0:
        return images
    grey = 255.0 / peak
    level = images.mean((1, 2), keepdim=True, dtype=torch.float64).float()  # subtracted: float32 loses less
    noisy = padded((images - level) * grey)
    shape = tuple(noisy.shape[1:])
    coefficients = block_table(noisy)
    tiles = max(1, int(min(memory, 1e15) // TILE_BYTES))
    basic = aggregate(*threshold_step(coefficients, shape, sigma * grey, profile, tiles), shape)
    final = aggregate(*wiener_step(coefficients, basic, sigma * grey, profile, tiles), shape)
    height, width = images.shape[1:]
    return final[:, :height, :width] / grey + level


def padded(images: Tensor) -> Tensor:
    """Return images [B, H, W] reflected at bottom and right until reference blocks, STEP apart, end at the border."""
    for axis in (1, 2):
        side = images.shape[axis]
        extra = max(BLOCK - side, 0) or -(side - BLOCK) % STEP
        place = torch.arange(side + extra, device=images.device).remainder(2 * side)
        images = images.index_select(axis, torch.minimum(place, 2 * side - 1 - place))
    return images


@lru_cache(maxsize=16)
def _dct(device: torch.device) -> Tensor:
    """Return the DCT of a block, [64, 64]."""
    return bm3d.dct_matrix().to(device)


@lru_cache(maxsize=16)
def _to_wavelet(device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the matrices from DCT to wavelet coefficients and back, [64, 64] each."""
    matrix = bm3d.wavelet_matrix() @ bm3d.dct_matrix().T
    return matrix.to(device), torch.linalg.inv(matrix).to(device)


@lru_cache(maxsize=16)
def _haar(stack: int, device: torch.device) -> Tensor:
    """Return the Haar matrices of stacks of 1, 2, 4, ... `stack` blocks, with zeros for the others, [n, stack, stack].

    A stack of two has the matrix of two in the corner: it takes the first two blocks, and adds to these alone.
    """
    sizes = [2**k for k in range(stack.bit_length())]
    found = torch.zeros(len(sizes), stack, stack)
    for matrix, size in zip(found, sizes, strict=True):
        matrix[:size, :size] = bm3d.haar_matrix(size)
    return found.to(device)


@lru_cache(maxsize=16)
def _kaiser(device: torch.device) -> Tensor:
    """Return the weights of the pixels of a block, [64, 1]."""
    one = torch.asarray(np.kaiser(BLOCK, bm3d.KAISER), dtype=torch.float32)
    return torch.outer(one, one).reshape(AREA, 1).to(device)


def block_table(images: Tensor) -> Tensor:
    """Return the DCT of the block at every position, [B, table height, table width, 64]; zeros outside the image."""
    batch, height, width = images.shape
    rows, columns = bm3d.table_size((height, width))[2:]
    blocks = images.unfold(1, BLOCK, 1).unfold(2, BLOCK, 1).flatten(3)
    table = images.new_zeros(batch, rows, columns, AREA)
    inner = table[:, RADIUS : RADIUS + blocks.shape[1], RADIUS : RADIUS + blocks.shape[2]]
    inner.copy_(blocks @ _dct(images.device).T)
    return table


def _norms(table: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Return the squared length of every row, [B, table height, table width]; FAR outside the image."""
    norm = table.square().sum(-1)
    inside = (RADIUS, RADIUS + shape[0] - BLOCK + 1), (RADIUS, RADIUS + shape[1] - BLOCK + 1)
    for axis, (first, last) in enumerate(inside, 1):
        norm.narrow(axis, 0, first).fill_(FAR)
        norm.narrow(axis, last, norm.shape[axis] - last).fill_(FAR)
    return norm


@dataclass(frozen=True, eq=False)
class Matches:
    """Stacks of the n reference blocks of some tiles."""

    position: Tensor  # int64 [n, stack], rows of the table of the batch, nearest first
    octave: Tensor  # int64 [n], 2^octave blocks of a stack count
    exists: Tensor  # float32 [n], 0 of a block that lies outside the image

    def counts(self) -> Tensor:
        """Return 1 where a block of a stack counts, float32 [n, stack]."""
        place = torch.arange(self.position.shape[1], device=self.position.device)
        return (place < (1 << self.octave)[:, None]).to(torch.float32)


def match_blocks(
    table: Tensor,
    norm: Tensor,
    part: tuple[slice, slice],
    shape: tuple[int, ...],
    stack: int,
    limit: float,
) -> Matches:
    """Return the most similar blocks within the search window of every reference block, for `part`: images of the
    batch, and rows of tiles.
    """
    images, rows = part
    down = rows.stop - rows.start
    across = bm3d.table_size(shape)[1]
    height, width = table.shape[1:3]
    jump = TILE * STEP
    top = rows.start * jump
    batch = images.stop - images.start
    plane = height * width
    start = images.start * plane + top * width
    size = (batch, down, across, REACH, REACH)
    strides = (plane, jump * width, jump, width, 1)
    seen = table.as_strided((*size, AREA), (*(AREA * stride for stride in strides), 1), start * AREA)
    inner = slice(RADIUS, -RADIUS, STEP)
    reference = seen[..., inner, inner, :].reshape(batch * down * across, TILE * TILE, AREA)
    candidates = seen.reshape(batch * down * across, REACH * REACH, AREA)
    far = norm.as_strided(size, strides, start).reshape(-1, 1, REACH * REACH)
    # The reference's own norm is added to its winners below.
    distance = torch.baddbmm(far, reference, candidates.mT, alpha=-2)
    del candidates
    # From the region of the tile to the window of each block: windows of neighbours lie STEP positions apart.
    area = REACH * REACH
    window = distance.as_strided(
        (len(distance), TILE, TILE, SIDE, SIDE),
        (TILE * TILE * area, TILE * area + STEP * REACH, area + STEP, REACH, 1),
    ).reshape(len(distance), TILE * TILE, SIDE * SIDE)
    del distance
    window[..., SIDE * RADIUS + RADIUS] = -FAR
    best, index = window.topk(stack, largest=False)
    del window
    corner = _corners((batch, down, across), (plane, width), table.device) + start
    position = corner[..., None] + index.div(SIDE, rounding_mode="floor") * width + index.remainder(SIDE)
    own = norm.flatten().index_select(0, position[..., 0].flatten())
    similar = (best.flatten(0, 1) + own[:, None] <= limit * AREA).sum(-1)
    octave = similar.clamp(min=1).to(torch.float32).log2().floor().long()
    return Matches(position.flatten(0, 1), octave, (own < FAR).to(torch.float32))


def _corners(size: tuple[int, int, int], steps: tuple[int, int], device: torch.device) -> Tensor:
    """Return the first position of each search window from that of the first, int64 [tiles, 64]."""
    plane, width = steps
    batch, down, across = (torch.arange(n, device=device) for n in size)
    inner = torch.arange(TILE, device=device) * STEP
    jump = TILE * STEP
    tiles = (batch[:, None, None] * plane + down[:, None] * (jump * width) + across * jump).flatten()
    return tiles[:, None] + (inner[:, None] * width + inner).flatten()


def _parts(batch: int, shape: tuple[int, ...], tiles: int) -> list[tuple[slice, slice]]:
    """Return images of a batch, and rows of tiles, that are computed together: about `tiles` tiles each."""
    down, across = bm3d.table_size(shape)[:2]
    rows = min(down, max(1, tiles // across))
    images = max(1, tiles // (down * across))
    return [
        (slice(image, min(image + images, batch)), slice(row, min(row + rows, down)))
        for image in range(0, batch, images)
        for row in range(0, down, rows)
    ]


def threshold_step(
    table: Tensor, shape: tuple[int, ...], sigma: float, profile: Profile, tiles: int
) -> tuple[Tensor, Tensor]:
    """Return sums of weighted rows [B, rows, columns, 64] after hard thresholding, and of their weights."""
    total, weights = _nothing(table)
    forward, back = _to_wavelet(table.device)
    wavelets = (table @ forward.T).view(-1, AREA)
    norm = _norms(table, shape)
    limit = profile.limit + 2 * sigma**2
    for part in _parts(len(table), shape, tiles):
        found = match_blocks(table, norm, part, shape, profile.stack, limit)
        haar = _haar(profile.stack, table.device).index_select(0, found.octave)
        stack = haar @ wavelets[found.position]
        kept = stack.abs() >= profile.threshold * sigma
        # The coefficient of the mean is never thresholded: it is not sparse, and holds the brightness.
        kept[:, 0, 0] = True
        stack *= kept
        # The article's weight: a stack counts inversely to the noise that its kept coefficients hold.
        held = torch.count_nonzero(stack, (1, 2)).clamp(min=1)
        _add(total, weights, found, haar.mT @ stack, held.to(torch.float32).reciprocal_() / sigma**2)
    return total @ back.T, weights


def wiener_step(table: Tensor, basic: Tensor, sigma: float, profile: Profile, tiles: int) -> tuple[Tensor, Tensor]:
    """Return the same sums after an empirical Wiener filter, whose spectrum comes from the basic estimate."""
    total, weights = _nothing(table)
    shape = tuple(basic.shape[1:])
    pilot_table = block_table(basic)
    norm = _norms(pilot_table, shape)
    pilot = pilot_table.view(-1, AREA)
    noisy = table.view(-1, AREA)
    for part in _parts(len(table), shape, tiles):
        found = match_blocks(pilot_table, norm, part, shape, profile.second_stack, profile.second_limit)
        haar = _haar(profile.second_stack, table.device).index_select(0, found.octave)
        gain = (haar @ pilot[found.position]).square_()
        gain /= gain + sigma**2
        # Nor does the Wiener filter shrink the mean, which would darken the picture.
        gain[:, 0, 0] = 1
        # Likewise: the noise behind a Wiener filter is the sum of its squared gains.
        held = gain.square().sum((1, 2))
        stack = gain.mul_(haar @ noisy[found.position])
        _add(total, weights, found, haar.mT @ stack, held.reciprocal_() / sigma**2)
    return total, weights


def _nothing(table: Tensor) -> tuple[Tensor, Tensor]:
    """Return the sums of rows and weights before anything is added."""
    return torch.zeros_like(table), table.new_zeros(table.shape[:3])


def _add(total: Tensor, weights: Tensor, found: Matches, stack: Tensor, weight: Tensor) -> None:
    """Add weighted stacks [n, size, 64] to the running sums, at their positions."""
    weight = (weight * found.exists)[:, None]
    place = found.position.flatten()
    total.view(-1, AREA).index_add_(0, place, (stack * weight[..., None]).view(-1, AREA))
    weights.view(-1).index_add_(0, place, (found.counts() * weight).flatten())


def aggregate(total: Tensor, weights: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Return the weighted means of all overlapping filtered blocks: images [B, *shape]."""
    batch, height, width = weights.shape
    # Blocks are weighted less at their borders, which would show in the picture.
    kaiser = _kaiser(total.device)
    pixels = _dct(total.device).T @ total.view(batch, -1, AREA).mT
    both = torch.cat([pixels * kaiser, kaiser * weights.view(batch, 1, -1)], dim=1)
    size = (height + BLOCK - 1, width + BLOCK - 1)
    above, below = functional.fold(both, size, BLOCK).unbind(1)
    inner = (slice(None), slice(RADIUS, RADIUS + shape[0]), slice(RADIUS, RADIUS + shape[1]))
    return above[inner] / below[inner]
