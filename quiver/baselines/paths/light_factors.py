"""Finds by how much the light of each frame of a window differs from that of its reference frame.

    phi of pooled codes [B, K, h, w] -> median over squares of their ratio to the reference -> factors [B, K]

Light that changes brightens all squares of a picture alike. What moves brightens some and darkens others, so that the
median stays. A factor counts only where it is beyond what the spread of the squares explains, and within RANGE: beyond
that the frame is another scene, or a faulty one. Otherwise it is 1.
"""

from __future__ import annotations

import torch
from torch import Tensor

SQUARE = 2  # cells of 8 px: side of the squares
FEWEST = 16  # squares; fewer tell nothing
CERTAIN = 6.0  # standard errors of a median that noise and motion may reach
LEAST = 0.02  # of phi, below which a change is left to the weights of frames
RANGE = (0.2, 5.0)  # of the factor of mean codes
DEVIATION = 1.4826  # of normal numbers over their median absolute deviation
MEDIAN = 1.2533  # standard error of a median over that of a mean
DIM = 0.05  # phi or codes, to which the reference is raised before it divides


def light_factors(phi: Tensor, codes: Tensor, centre: int) -> tuple[Tensor, Tensor]:
    """Return factors of phi and of mean codes [B, K] over the frame `centre`; 1 where light is constant.

    `phi` [B, K, h, w] is that of codes pooled over 8 x 8 px, and `codes` [B, K, h, w] are those pooled codes.
    """
    ones = phi.new_ones(phi.shape[:2])
    rows, columns = (side // SQUARE for side in phi.shape[-2:])
    if rows * columns < FEWEST:
        return ones, ones
    of_phi, errors = _ratios(phi, centre)
    of_codes, _ = _ratios(codes, centre)
    changed = (of_phi - 1).abs() > CERTAIN * errors + LEAST
    changed &= (of_codes > RANGE[0]) & (of_codes < RANGE[1]) & (of_phi > RANGE[0])
    return torch.where(changed, of_phi, ones), torch.where(changed, of_codes, ones)


def _ratios(cells: Tensor, centre: int) -> tuple[Tensor, Tensor]:
    """Return the median over squares of the ratio to one frame, [B, K], and its standard error."""
    squares = torch.nn.functional.avg_pool2d(cells, SQUARE).flatten(2)
    ratios = squares / squares[:, centre, None].clamp(min=DIM)
    factors = ratios.median(-1).values
    spread = DEVIATION * (ratios - factors[..., None]).abs().median(-1).values
    return factors, MEDIAN * spread / ratios.shape[-1] ** 0.5
