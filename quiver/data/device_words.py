"""Draws the random words of qsim/keys.py on the device of torch, for a batch of windows under one key each.

Torch has no unsigned numbers of 32 bits with products of 64, so words are kept in int64. The high half of a product is
its upper 32 bits, whatever its sign.
"""

from __future__ import annotations

import torch
from torch import Tensor

from qsim.keys import KEY_STEPS, MULTIPLIERS, ROUNDS

_LOW = 0xFFFFFFFF


def words(high: Tensor, low: Tensor, shape: tuple[int, int, int], redraws: int = 1) -> Tensor:
    """Return a word for each pixel of windows [T, H, W] that begin at frame, row and column 0: int64 [B, r, T, H, W].

    `high` and `low` [B] are the halves of the 64-bit Philox keys; the word r of a pixel is that of `redraw` r.
    """
    frames, height, width = shape
    device = high.device
    x = torch.arange((width + 3) // 4, device=device)
    y = torch.arange(height, device=device)[:, None]
    frame = torch.arange(frames, device=device)[:, None, None]
    redraw = torch.arange(redraws, device=device)[:, None, None, None]
    keys = (half[:, None, None, None, None] for half in (high, low))
    four = torch.broadcast_tensors(*_philox(x, y, frame, redraw, *keys))
    return torch.stack(four, dim=-1).flatten(-2)[..., :width]


def words_at(
    high: Tensor | int, low: Tensor | int, frame: Tensor, y: Tensor, x: Tensor, redraw: Tensor | int = 0
) -> Tensor:
    """Return the words of single pixels of the full frame, int64 [...]: all arguments are broadcast to one shape."""
    four = _philox(x >> 2, y, frame, redraw, high, low)
    found = four[0]
    for n in (1, 2, 3):
        found = torch.where((x & 3) == n, four[n], found)
    return found


def _philox(
    c0: Tensor,
    c1: Tensor,
    c2: Tensor,
    c3: Tensor | int,
    k0: Tensor | int,
    k1: Tensor | int,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the four words of blocks: int64 [...] each, not yet of one shape."""
    for _ in range(ROUNDS):
        even = c0 * MULTIPLIERS[0]
        odd = c2 * MULTIPLIERS[1]
        c0 = _high(odd) ^ c1 ^ k0
        c1 = odd & _LOW
        c2 = _high(even) ^ c3 ^ k1
        c3 = even & _LOW
        k0 = (k0 + KEY_STEPS[0]) & _LOW
        k1 = (k1 + KEY_STEPS[1]) & _LOW
    assert isinstance(c3, Tensor)
    return c0, c1, c2, c3


def uniform(first: Tensor, second: Tensor) -> Tensor:
    """Return numbers of 64 bits in (0, 1), float64, of two words each: those of `qsim.keys.uniform`."""
    low = (second.double() + 0.5) * 2.0**-32
    return (first.double() + low) * 2.0**-32


def uniform_of_one(word: Tensor) -> Tensor:
    """Return numbers of 32 bits in (0, 1), float64, of one word each: those of `qsim.keys.uniform`."""
    return (word.double() + 0.5) * 2.0**-32


def _high(product: Tensor) -> Tensor:
    return (product >> 32) & _LOW
