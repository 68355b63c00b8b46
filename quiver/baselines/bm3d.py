"""Removes white Gaussian noise from one image by BM3D, which filters stacks of similar blocks together.

    image -> (match, Haar x wavelet, hard threshold, aggregate) = basic -> (match on basic, Haar x DCT, Wiener) ->
    denoised

Source: Dabov, Foi, Katkovnik, Egiazarian, "Image denoising by sparse 3-D transform-domain collaborative filtering",
IEEE TIP 16(8), 2007; written from the description, with the parameters of its normal profile. Our reading: in the first
step blocks are similar if their distance exceeds that of two noisy copies of one block, 2 sigma^2, by at most 3000.
That replaces the article's second set of parameters for strong noise, and needs no filter before matching. The mean of
a stack is never shrunk, so the position of grey level 0 does not matter.

No loop runs over pixels: the transformed block at every position is one row of a table [positions, 64]. Distances are
matrix products of rows (a DCT keeps distances); stacks are gathered rows, and filtered rows are added at their
positions, so that each position is transformed back once. Memory: about 1.2 kB per pixel. The package `bm3d` is not
used: its licence forbids commercial use.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy import ndarray as Array
from torch import Tensor

from qsim.arrays import plain

BLOCK = 8  # pixels, side of a block
AREA = BLOCK * BLOCK
RADIUS = 19  # pixels: a search window of 39 x 39
STEP = 3  # pixels between reference blocks
TILE = 8  # reference blocks per side of a tile that shares one matrix product
REACH = STEP * (TILE - 1) + 2 * RADIUS + 1  # positions per side in the search windows of a tile
KAISER = 2.0  # shape parameter of the window that weighs the pixels of a block
FAR = 1e30  # squared distance of a position outside the image


@dataclass(frozen=True)
class Profile:
    """Parameters of the two steps; distances per pixel in squared grey levels of 0 ... 255."""

    threshold: float = 2.7  # deviations below which the first step sets a coefficient to zero
    stack: int = 16  # similar blocks per stack of the first step, at most; a power of two
    limit: float = 3000.0  # squared distance up to which blocks are similar, beyond the 2 sigma^2 of noise alone
    second_stack: int = 32  # the same for the second step
    second_limit: float = 400.0  # of blocks of the basic estimate, whose noise is gone


def denoise(image: Array, sigma: float, *, peak: float = 1.0, profile: Profile = Profile()) -> Array:
    """Return an image [H, W] without its white noise of deviation `sigma`: float32 [H, W], same unit.

    `peak` is the image value that stands for 255 grey levels, the unit of the profile's limits. `ValueError` for input
    that is not an image, and for an impossible deviation.
    """
    image = plain(image)
    if image.ndim != 2 or image.size == 0 or not np.all(np.isfinite(image)):
        raise ValueError(f"image: expected finite numbers [H, W], got {image.dtype} {image.shape}")
    if not (sigma >= 0 and np.isfinite(sigma) and peak > 0):
        raise ValueError(f"sigma must be 0 or more and peak positive, got sigma {sigma!r} and peak {peak!r}")
    if sigma == 0:
        return image.astype(np.float32)
    grey = 255.0 / peak
    level = float(image.mean(dtype=np.float64))  # subtracted: float32 loses less
    noisy = torch.asarray(pad((image - level) * grey), dtype=torch.float32)
    coefficients = block_table(noisy)
    basic = aggregate(*threshold_step(coefficients, noisy.shape, sigma * grey, profile), noisy.shape)
    final = aggregate(*wiener_step(coefficients, basic, sigma * grey, profile), noisy.shape)
    height, width = image.shape
    return np.asarray(final[:height, :width] / grey + level)


def pad(image: Array) -> Array:
    """Return the image reflected at bottom and right until reference blocks, STEP apart, end exactly at the border."""
    extra = [max(BLOCK - side, 0) or -(side - BLOCK) % STEP for side in image.shape]
    return np.pad(image, [(0, extra[0]), (0, extra[1])], mode="symmetric")


def dct_matrix() -> Tensor:
    """Return the orthonormal 2-D DCT-II of a block as a matrix [64 coefficients, 64 pixels]."""
    n = np.arange(BLOCK)
    one = np.cos(np.pi * (2 * n[None, :] + 1) * n[:, None] / (2 * BLOCK)) * np.sqrt(2 / BLOCK)
    one[0] /= np.sqrt(2)
    return torch.asarray(np.kron(one, one), dtype=torch.float32)


def wavelet_matrix() -> Tensor:
    """Return the periodic biorthogonal 1.5 wavelet transform of a block, rows of unit length: [64, 64 pixels]."""
    low = np.array([3, -3, -22, 22, 128, 128, 22, -22, -3, 3]) / (128 * np.sqrt(2))
    one = np.eye(BLOCK)
    size = BLOCK
    while size > 1:
        # One level halves the averages that the last one left; the differences stay as they are.
        level = np.zeros((size, size))
        for k in range(size // 2):
            np.add.at(level[k], (2 * k + np.arange(-4, 6)) % size, low)
            level[size // 2 + k, 2 * k : 2 * k + 2] = [np.sqrt(0.5), -np.sqrt(0.5)]
        one[:size] = level @ one[:size]
        size //= 2
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    return torch.asarray(np.kron(one, one), dtype=torch.float32)


def haar_matrix(size: int) -> Tensor:
    """Return the orthonormal Haar transform over `size` (a power of two) blocks, [size, size]."""
    matrix = np.ones((1, 1))
    while len(matrix) < size:
        fine = np.kron(np.eye(len(matrix)), [1, -1])
        matrix = np.concatenate([np.kron(matrix, [1, 1]), fine]) / np.sqrt(2)
    return torch.asarray(matrix, dtype=torch.float32)


def table_size(shape: tuple[int, ...]) -> tuple[int, int, int, int]:
    """Return tiles down and across, and height and width of the table of positions: the image's, with a border for the
    search.
    """
    down, across = (-(-((side - BLOCK) // STEP + 1) // TILE) for side in shape)
    return down, across, STEP * TILE * (down - 1) + REACH, STEP * TILE * (across - 1) + REACH


def block_table(image: Tensor) -> Tensor:
    """Return the DCT of the block at every position: rows [table height * table width, 64]; zeros outside the image."""
    _, _, height, width = table_size(image.shape)
    table = torch.zeros(height, width, AREA)
    side = image.shape[1]
    shape = image.shape[0] - BLOCK + 1, side - BLOCK + 1, BLOCK, BLOCK
    # Strides are those of C order: an image of another order is copied.
    blocks = image.contiguous().as_strided(shape, (side, 1, side, 1))  # [positions down, across, 8, 8], a view
    basis = dct_matrix().T
    for y, row in enumerate(blocks):
        table[y + RADIUS, RADIUS : RADIUS + len(row)] = row.reshape(-1, AREA) @ basis
    return table.reshape(-1, AREA)


def inside_image(shape: tuple[int, ...]) -> Tensor:
    """Return which positions of the table [height, width] hold a block of the image."""
    _, _, height, width = table_size(shape)
    inside = torch.zeros((height, width), dtype=torch.bool)
    inside[RADIUS : RADIUS + shape[0] - BLOCK + 1, RADIUS : RADIUS + shape[1] - BLOCK + 1] = True
    return inside


@dataclass(frozen=True)
class Matches:
    """The stacks of one row of tiles."""

    position: Tensor  # [references, stack], rows of the table, nearest first, the reference at 0
    size: Tensor  # [references], blocks of the stack that count: a power of two


def match_blocks(
    table: Tensor, norm: Tensor, tile_row: int, shape: tuple[int, ...], stack: int, limit: float
) -> Matches:
    """Return the most similar blocks within the search window of every reference block in one row of tiles."""
    _, across, _, width = table_size(shape)
    top = tile_row * TILE * STEP
    jump = TILE * STEP
    view = table.as_strided((across, REACH, REACH, AREA), (jump * AREA, width * AREA, AREA, 1), top * width * AREA)
    candidates = view.reshape(across, REACH * REACH, AREA)
    reference = view[:, RADIUS : -RADIUS or None : STEP, RADIUS : -RADIUS or None : STEP]
    reference = reference.reshape(across, TILE * TILE, AREA)
    far = norm.as_strided((across, 1, REACH, REACH), (jump, 0, width, 1), top * width)
    distance = (reference @ candidates.mT).reshape(across, TILE * TILE, REACH, REACH)
    distance *= -2
    distance += far  # the reference's own norm is added to its winners below
    # From the region of the tile to the window of each block: windows of neighbours lie STEP positions apart.
    side = 2 * RADIUS + 1
    area = REACH * REACH
    window = distance.as_strided(
        (across, TILE, TILE, side, side),
        (TILE * TILE * area, TILE * area + STEP * REACH, area + STEP, REACH, 1),
    ).reshape(across, TILE, TILE, side * side)
    window[..., side * RADIUS + RADIUS] = -FAR
    best, index = window.topk(stack, largest=False)
    corner = top * width + torch.arange(across)[:, None, None] * jump
    corner = corner + torch.arange(TILE)[:, None] * STEP * width + torch.arange(TILE) * STEP
    position = corner[..., None] + index // side * width + index % side
    own = norm.reshape(-1)[position[..., 0]]
    similar = (best + own[..., None] <= limit * AREA).sum(-1)
    exists = own < FAR
    size = 2 ** similar.clip(min=1).log2().floor().long()
    return Matches(position[exists], size[exists])


def norms(table: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Return the squared length of every row [table height, width]; FAR outside the image."""
    inside = inside_image(shape)
    return torch.where(inside, torch.square(table).sum(1).reshape(inside.shape), FAR)


def similar_blocks(table: Tensor, shape: tuple[int, ...], stack: int, limit: float) -> list[Tensor]:
    """Return all stacks as positions [n, size], one tensor per size and row of tiles."""
    norm = norms(table, shape)
    found = []
    for tile_row in range(table_size(shape)[0]):
        matches = match_blocks(table, norm, tile_row, shape, stack, limit)
        for size in np.unique(matches.size).tolist():
            found.append(matches.position[matches.size == size][:, :size])
    return found


def threshold_step(table: Tensor, shape: tuple[int, ...], sigma: float, profile: Profile) -> tuple[Tensor, Tensor]:
    """Return sums of weighted rows [positions, 64] after hard thresholding, and of their weights [positions]."""
    total = torch.zeros_like(table)
    weights = torch.zeros(len(table))
    to_wavelet = wavelet_matrix() @ dct_matrix().T
    wavelets = table @ to_wavelet.T
    for position in similar_blocks(table, shape, profile.stack, profile.limit + 2 * sigma**2):
        haar = haar_matrix(position.shape[1])
        stack = haar @ wavelets[position]
        small = torch.abs(stack) < profile.threshold * sigma
        # The coefficient of the mean is never thresholded: it is not sparse, and holds the brightness.
        small[:, 0, 0] = False
        stack[small] = 0
        # The article's weight: a stack counts inversely to the noise that its kept coefficients hold.
        weight = 1 / (sigma**2 * torch.clip(torch.count_nonzero(stack, (1, 2)), 1, None))
        add_blocks(total, weights, position, haar.T @ stack, weight)
    return total @ torch.linalg.inv(to_wavelet).T, weights


def wiener_step(table: Tensor, basic: Tensor, sigma: float, profile: Profile) -> tuple[Tensor, Tensor]:
    """Return the same sums after an empirical Wiener filter, whose spectrum comes from the basic estimate."""
    total = torch.zeros_like(table)
    weights = torch.zeros(len(table))
    pilot_table = block_table(basic)
    for position in similar_blocks(pilot_table, basic.shape, profile.second_stack, profile.second_limit):
        haar = haar_matrix(position.shape[1])
        power = torch.square(haar @ pilot_table[position])
        gain = power / (power + sigma**2)
        # Nor does the Wiener filter shrink the mean, which would darken the picture.
        gain[:, 0, 0] = 1
        # Likewise: the noise behind a Wiener filter is the sum of its squared gains.
        weight = 1 / (sigma**2 * torch.square(gain).sum((1, 2)))
        stack = gain * (haar @ table[position])
        add_blocks(total, weights, position, haar.T @ stack, weight)
    return total, weights


def add_blocks(total: Tensor, weights: Tensor, position: Tensor, stack: Tensor, weight: Tensor) -> None:
    """Add weighted stacks [n, size, 64] to the running sums, at their positions."""
    weight = weight[:, None]
    total.index_add_(0, position.reshape(-1), (stack * weight[..., None]).reshape(-1, AREA))
    weights.index_add_(0, position.reshape(-1), torch.broadcast_to(weight, position.shape).reshape(-1))


def aggregate(total: Tensor, weights: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Return the weighted mean of all overlapping filtered blocks: an image of this shape."""
    height, width = table_size(shape)[2:]
    # Blocks are weighted less at their borders, which would show in the picture.
    kaiser = torch.asarray(np.kaiser(BLOCK, KAISER), dtype=torch.float32)
    kaiser = torch.outer(kaiser, kaiser).reshape(-1)
    pixels = (dct_matrix().T @ total.T * kaiser[:, None]).reshape(AREA, height, width)
    weight = weights.reshape(height, width)
    above, below = torch.zeros(2, height + BLOCK - 1, width + BLOCK - 1)
    for k in range(AREA):
        y, x = divmod(k, BLOCK)
        above[y : y + height, x : x + width] += pixels[k]
        below[y : y + height, x : x + width] += kaiser[k] * weight
    inner = slice(RADIUS, RADIUS + shape[0]), slice(RADIUS, RADIUS + shape[1])
    return above[inner] / below[inner]
