"""Lists why a host would wait for its GPU, on the `meta` device, where tensors have no values."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

OPERATORS = ("_local_scalar_dense", "nonzero", "is_nonzero", "equal", "masked_select", "_unique2", "unique_dim")
FROM_HOST = (torch.tensor, torch.as_tensor, torch.asarray, torch.from_numpy, Tensor.new_tensor)  # a copy that waits


class _Operators(TorchDispatchMode):
    def __init__(self, found: list[str]) -> None:
        super().__init__()
        self.found = found
        self.count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count += not func.is_view
        name = func.name().removeprefix("aten::").partition(".")[0]
        tensors = [value for value in torch.utils._pytree.tree_leaves((args, kwargs)) if isinstance(value, Tensor)]
        on_device = any(tensor.device.type == "meta" for tensor in tensors)
        on_device |= getattr((kwargs or {}).get("device"), "type", "") == "meta"
        from_host = any(tensor.device.type == "cpu" and tensor.ndim for tensor in tensors)
        masked = name in ("index", "index_put", "index_put_") and any(
            tensor.dtype == torch.bool for tensor in torch.utils._pytree.tree_leaves(args[1])
        )
        if on_device and (name in OPERATORS or from_host or masked):
            self.found.append(name)
        return func(*args, **(kwargs or {}))


class _Functions(TorchFunctionMode):
    def __init__(self, found: list[str]) -> None:
        super().__init__()
        self.found = found

    def __torch_function__(self, func: Callable[..., Any], types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func in FROM_HOST:
            self.found.append(func.__name__)
        return func(*args, **(kwargs or {}))


@contextmanager
def listed_waits() -> Iterator[tuple[list[str], _Operators]]:
    """Yield a list that receives the name of everything that would wait, and a counter of operators."""
    found: list[str] = []
    operators = _Operators(found)
    with _Functions(found), operators:
        yield found, operators
