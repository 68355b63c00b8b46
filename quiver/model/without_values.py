"""Makes layers without their first values."""

from typing import Any

from torch.overrides import TorchFunctionMode


class WithoutValues(TorchFunctionMode):
    """Makes layers without first values: every function that sets values in place does nothing.

    On "meta", the first of some of these functions imports for two seconds. `t_` acts, because it sets a
    shape: `torch.nn.init.orthogonal_` needs it, which does nothing on "meta" in later versions of torch only.
    """

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Run a function, unless it sets values."""
        if func.__name__.endswith("_") and not func.__name__.endswith("__") and func.__name__ != "t_":
            return args[0] if args else (kwargs or {})["tensor"]  # the latter for functions of torch.nn.init
        return func(*args, **(kwargs or {}))
