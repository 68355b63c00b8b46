"""Makes networks by name (names.py), and the ablations of the paper."""

from dataclasses import replace
from functools import cache
from importlib import import_module
from typing import Any, NoReturn

import torch
from torch import nn
from torch.overrides import TorchFunctionMode

from quiver.host import own_numbers
from quiver.model import names
from quiver.model.config import Config
from quiver.model.mosaic_network import MosaicNet, MosaicNetConfig
from quiver.model.quiver import QUIVER


def _class(home: str) -> type[nn.Module]:
    """Return the class of a network at module:class in quiver.model."""
    module, _, name = home.partition(":")
    network: type[nn.Module] = getattr(import_module(f"quiver.model.{module}"), name)
    return network


def _config_of(network: type[nn.Module]) -> type:
    """Return the class of a network's configuration, which stands beside it."""
    module = import_module(network.__module__)
    kind: type = Config if network is QUIVER else getattr(module, f"{network.__name__}Config")
    return kind


# Each network with its configuration. The name of the class stands in weights files.
NETWORKS: dict[type[nn.Module], type] = {
    network: _config_of(network) for network in (_class(preset.home) for preset in names.PRESETS.values())
}
PRESETS: dict[str, Any] = {
    name: NETWORKS[_class(preset.home)](**preset.settings) for name, preset in names.PRESETS.items()
}

# Rows of the paper's Table 4, without that of the pretrained flow: pre-denoiser, flow, multi-scale outputs.
ABLATIONS: dict[str, tuple[bool, bool, bool]] = {
    "none": (False, False, False),
    "denoiser+flow": (True, True, False),
    "scales": (False, False, True),
    "flow+scales": (False, True, True),
    "denoiser+scales": (True, False, True),
    "all": (True, True, True),
}


def ablated(config: Config, row: str) -> Config:
    """Return the configuration without the parts that a row lacks, at similar capacity; ValueError for other rows.

    The recurrent cell is widened to keep the parameter count: the growth of its blocks is the integer that brings the
    count closest to that of `config`.
    """
    if row not in ABLATIONS:
        raise ValueError(f"no ablation is called {row!r}; known: {', '.join(ABLATIONS)}")
    pre_denoiser, flow, multi_scale = ABLATIONS[row]
    wanted = parameter_count(config)
    smaller = replace(config, pre_denoiser=pre_denoiser, flow=flow, multi_scale=multi_scale)
    growth = config.cell_growth or 2 * config.channels
    while parameter_count(smaller) < wanted:
        before = smaller
        growth += 1
        smaller = replace(smaller, cell_growth=growth)
        if abs(parameter_count(before) - wanted) < abs(parameter_count(smaller) - wanted):
            return before
    return smaller


@cache
def parameter_count(config: Config) -> int:
    """Return the number of parameters, counted without memory for them."""
    with torch.device("meta"), WithoutValues():
        return sum(parameter.numel() for parameter in QUIVER(config).parameters())


@own_numbers
def build(name: str) -> nn.Module:
    """Return a network by its name, with random weights; ValueError for other names."""
    if name not in PRESETS:
        raise ValueError(f"no network is called {name!r}; known: {', '.join(PRESETS)}")
    return made(PRESETS[name])


def made(config: Any) -> nn.Module:
    """Return the network of a configuration of any kind, with random weights."""
    if isinstance(config, MosaicNetConfig):
        return MosaicNet(config, made(configuration(config.core, dict(config.settings))))
    return next(network(config) for network, kind in NETWORKS.items() if kind is type(config))


def configuration(kind: str, values: dict[str, object]) -> Any:
    """Return the configuration of a class of networks from its values; `ValueError` for others."""
    kinds: dict[str, Any] = {network.__name__: config for network, config in NETWORKS.items()}
    if kind == MosaicNet.__name__:
        found = MosaicNetConfig.from_dict(values)
        if found.core not in kinds:  # of a core that is a MosaicNet, too, the depth would have no bound
            _unknown(found.core)
        return found
    return kinds[kind].from_dict(values) if kind in kinds else _unknown(kind)


def _unknown(kind: str) -> NoReturn:
    raise ValueError(f"no network is called {kind[:60]!r}")


def on_mosaics(network: nn.Module, mask: tuple[str, ...]) -> MosaicNet:
    """Return a network of one band with a learned end for a mask; the end is untrained, and returns linear bands.

    `ValueError` for one with an end for another mask.
    """
    if isinstance(network, MosaicNet):
        if network.config.mask != mask:
            raise ValueError(
                f"these weights are for the mask {' '.join(network.config.mask)}, and the clips have {' '.join(mask)}; "
                "start from weights of one band, or from none"
            )
        return network
    config: Any = network.config
    return MosaicNet(MosaicNetConfig(type(network).__name__, config.to_dict(), mask), network)


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
