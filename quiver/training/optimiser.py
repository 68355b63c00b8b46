"""Updates the weights: by Adam alone, or by Muon for the inner kernels and Adam for all other weights.

Muon (muon.py) sees a kernel as a matrix [out, in * h * w]. Its steps have the size of Adam's, so that both use one
learning rate.
"""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch import nn

from quiver.training.muon import Muon

Kind = Literal["adam", "muon"]
OPTIMISERS: tuple[Kind, ...] = ("adam", "muon")
_STORED = ({"step", "exp_avg", "exp_avg_sq"}, {"momentum_buffer"})  # keys of one weight in Adam and in Muon
EDGES = ("leave",)  # names of last layers, which Adam updates


class Optimiser:
    """Adam, or Muon and Adam, for the weights of a network, which must already be on their device.

    `ValueError` if the kind is Muon and a kernel is not contiguous.
    """

    def __init__(self, model: nn.Module, kind: Kind, rate: float, betas: tuple[float, float]) -> None:
        named = [(name, weight) for name, weight in model.named_parameters() if weight.requires_grad]
        inner = [(n, w) for n, w in named if kind == "muon" and w.ndim >= 4 and not set(EDGES) & set(n.split("."))]
        for name, weight in inner:
            if not weight.is_contiguous():
                raise ValueError(f"{name}: Muon sees kernels as matrices in the same memory; make it contiguous first")
        self.kernels = [weight for _, weight in inner]
        # Muon takes matrices: a view of a kernel changes the kernel.
        self.matrices = [nn.Parameter(weight.detach().flatten(1)) for weight in self.kernels]  # the same memory
        rest = [weight for _, weight in named if not any(weight is kernel for kernel in self.kernels)]
        self.parts: list[torch.optim.Optimizer] = [torch.optim.Adam(rest, lr=rate, betas=betas, eps=1e-8)]
        if self.matrices:
            self.parts.append(Muon(self.matrices, rate))

    def step(self, rate: float) -> None:
        """Update the weights by their gradients; a weight without gradient does not change."""
        for kernel, matrix in zip(self.kernels, self.matrices, strict=True):
            matrix.grad = None if kernel.grad is None else kernel.grad.flatten(1)
        for part in self.parts:
            for group in part.param_groups:
                group["lr"] = rate
            part.step()

    def state_dict(self) -> dict[str, Any]:
        """Return all that the next step depends on, apart from weights and rate."""
        return {"parts": [part.state_dict() for part in self.parts]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the state of `state_dict`; ValueError for any other content. Rates do not change."""
        parts = state.get("parts") if isinstance(state, dict) else None
        if not isinstance(parts, list) or len(parts) != len(self.parts):
            raise ValueError("the state of another optimiser")
        for part, content in zip(self.parts, parts, strict=True):
            part.load_state_dict(_checked(part, content))


def _checked(part: torch.optim.Optimizer, content: Any) -> dict[str, Any]:
    """Return a stored state with the settings of `part`; ValueError unless every tensor fits its weight."""
    ours = part.state_dict()
    weights = [weight for group in part.param_groups for weight in group["params"]]
    stored = content.get("state") if isinstance(content, dict) else None
    if not isinstance(stored, dict):
        raise ValueError("the state of another optimiser")
    for number, values in stored.items():
        if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < len(weights):
            raise ValueError(f"an optimiser state for weight {str(number)[:60]}, which does not exist")
        if not isinstance(values, dict) or set(values) not in _STORED:
            raise ValueError("the state of another optimiser")
        for name, value in values.items():
            shape = torch.Size() if name == "step" else weights[number].shape
            if not isinstance(value, torch.Tensor) or value.layout != torch.strided or value.shape != shape:
                raise ValueError(f"{name} of weight {number} is not a tensor of shape {list(shape)}")
            if not value.is_floating_point() or not bool(torch.isfinite(value).all()):
                raise ValueError(f"{name} of weight {number} holds values that are not finite numbers")
    return ours | {"state": stored}
