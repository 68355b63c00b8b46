"""Loads the state dict of a published network into ours, which has the same names."""

from collections.abc import Mapping

from torch import Tensor, nn


def load_published(network: nn.Module, state: Mapping[str, Tensor], unused: tuple[str, ...] = ()) -> list[str]:
    """Load a published state dict of any shape; return the entries that begin with one of `unused` and are not built.

    Buffers that the state lacks keep their constants. ValueError for parameters that are missing, for unknown entries,
    and for shapes that differ.
    """
    own = network.state_dict()
    constants = own.keys() - {name for name, _ in network.named_parameters()}
    left = [name for name in state if name not in own and name.startswith(unused)]
    title = type(network).__name__
    missing = sorted(own.keys() - state.keys() - constants)
    unknown = sorted(state.keys() - own.keys() - set(left))
    if missing or unknown:
        name, fault = (missing[0], "is missing") if missing else (unknown[0], "is unknown")
        raise ValueError(f"not a published state of {title}: {name} {fault}; give all entries of the published network")
    for name, value in state.items():
        if name in own and value.shape != own[name].shape:
            raise ValueError(
                f"not a published state of this {title}: {name} is {tuple(value.shape)}, expected "
                f"{tuple(own[name].shape)}; choose the width of the stored weights"
            )
    network.load_state_dict({name: value for name, value in state.items() if name in own}, strict=False)
    return left
