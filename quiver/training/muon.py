"""Muon: the momentum of a matrix is replaced by its polar factor, so that all its directions change at the same rate.

    gradient [rows, cols] -> momentum of Nesterov -> polar factor -> step in the size of Adam's

The polar factor comes from five steps of a polynomial of Newton-Schulz type, x <- a x + (b g + c g^2) x with g = x x^T,
which bring all singular values near 1 (Jordan et al. 2024, "Muon: an optimizer for hidden layers in neural networks").
The size is that of Liu et al. (2025), "Muon is scalable for LLM training".

`torch.optim.Muon` computes the same in bfloat16, one matrix after another. On a processor without such arithmetic that
took half of a training step. Here matrices of a shape are computed together, in float32 on the host.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from quiver.device import is_gpu

MOMENTUM = 0.95
STEPS = 5
POLYNOMIAL = (3.4445, -4.7750, 2.0315)  # steepest at 0 of those that stay near 1
SIZE = 0.2  # root of the mean square of a step of Adam
LEAST = 1e-7  # norm of a matrix, below which it is taken for zero


class Muon(torch.optim.Optimizer):
    """Updates matrices [rows, cols] by their gradients, with one momentum each."""

    def __init__(self, matrices: Iterable[Tensor], rate: float) -> None:
        super().__init__(matrices, {"lr": rate})

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # type: ignore[override]
        """Update the matrices that have a gradient. No `closure` is called: `TypeError` for one."""
        if closure is not None:
            raise TypeError("Muon calls no closure; compute the gradients before its step")
        for group in self.param_groups:
            alike: defaultdict[tuple[torch.Size, torch.device], list[tuple[Tensor, Tensor]]] = defaultdict(list)
            for matrix in group["params"]:
                if matrix.grad is not None:
                    alike[matrix.shape, matrix.device].append((matrix, self._ahead(matrix, matrix.grad)))
            for (shape, _), found in alike.items():
                matrices, ahead = zip(*found, strict=True)
                size = SIZE * max(shape) ** 0.5
                for matrix, factor in zip(matrices, polar_factors(torch.stack(ahead)), strict=True):
                    matrix.add_(factor, alpha=-group["lr"] * size)

    def _ahead(self, matrix: Tensor, gradient: Tensor) -> Tensor:
        """Return a gradient with its momentum, which it changes, as Nesterov looks ahead."""
        state = self.state[matrix]
        if not state:
            state["momentum_buffer"] = torch.zeros_like(matrix)
        momentum = state["momentum_buffer"].lerp_(gradient, 1 - MOMENTUM)
        return gradient.lerp(momentum, MOMENTUM)


def polar_factors(matrices: Tensor) -> Tensor:
    """Return matrices [N, rows, cols] with their singular values brought near 1, in 0.7 to 1.2 where they were above
    1/500 of the norm. Zero stays zero.
    """
    x = matrices.to(torch.bfloat16) if is_gpu(matrices.device) else matrices
    tall = x.shape[1] > x.shape[2]
    if tall:
        x = x.mT
    x = x / torch.linalg.matrix_norm(x, keepdim=True).clamp(min=LEAST)
    a, b, c = POLYNOMIAL
    for _ in range(STEPS):
        gram = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    if tall:
        x = x.mT
    return x.to(matrices.dtype)
