"""Counts the operators that run on a device, and finds those that wait for it."""

import torch
from torch.utils._python_dispatch import TorchDispatchMode


class Operators(TorchDispatchMode):
    """Counts what is asked of a device, and keeps the names of what waits for it or copies to it."""

    WAITS = ("_local_scalar_dense", "nonzero", "item", "is_nonzero", "equal", "masked_select", "unique")

    def __init__(self):
        super().__init__()
        self.count = 0
        self.waits = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.count += not func.is_view
        name = func.name().removeprefix("aten::").partition(".")[0]
        devices = {x.device.type for x in args if isinstance(x, torch.Tensor) and x.ndim}
        devices |= {str(x) for x in (kwargs or {}).values() if isinstance(x, torch.device)}
        if name in self.WAITS or len(devices) > 1:
            self.waits.append(name)
        return func(*args, **(kwargs or {}))
