"""Records the stages of FloRNN under the names of its golden file, for golden.py.

A file may hold the forward flows of the whole reflected clip, T-1+k, or those that the scored frame 1 needs, k+1.
"""

from collections.abc import Mapping

import numpy as np
import torch
from golden import fill_by_rule
from torch import Tensor, nn

from quiver.model.published_weights import load_published
from quiver.model.rivals.edges import reflected
from quiver.model.rivals.flornn import FloRNN, FloRNNConfig, Flows

INPUTS = ("codes", "noise_map", "flow_forward", "flow_backward")
SLICE = 4  # every fourth channel of a state is stored


def stages(arrays: Mapping[str, np.ndarray], weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """One run with the noise map of the file; frame 1 also with the zero map of the port."""
    network = built(arrays, weights)
    result = recorded(network, *inputs(arrays, network.config))
    if result["output"].shape[1] > 1:
        images, noise, flows = inputs(arrays, network.config, outputs=2)
        result["output_t1_zero_map"] = network.restore(images, torch.zeros_like(noise), flows)[:, 1]
    return result


def look_ahead(arrays: Mapping[str, np.ndarray]) -> int:
    """The number of frames k, from the number of flows; a file for frame 1 alone lacks those of later frames."""
    frames, forward, backward = (arrays[key].shape[1] for key in ("codes", "flow_forward", "flow_backward"))
    return forward - frames + 1 if forward >= frames and backward >= frames - 1 else forward - 1


def built(arrays: Mapping[str, np.ndarray], weights: Mapping[str, Tensor]) -> FloRNN:
    """A float64 network with published weights, of their sizes."""
    config = FloRNNConfig(
        width=len(weights["forward_rnn.first_conv.weight"]),
        blocks=sum(name.startswith("forward_rnn.") and name.endswith(".conv1.weight") for name in weights),
        look_ahead=look_ahead(arrays),
        image_channels=len(weights["d.convs.2.weight"]),
        flow_channels=(),
        as_published=True,
    )
    network = FloRNN(config).double().eval()
    load_published(network, weights, FloRNN.unused)
    return network


def inputs(
    arrays: Mapping[str, np.ndarray], config: FloRNNConfig, outputs: int | None = None
) -> tuple[Tensor, Tensor, Flows]:
    """Images [B, N, C, H, W], noise maps [B, N, 1, H, W] and flows for the first outputs; None: all that have flows."""
    codes, noise, forward, backward = (
        torch.from_numpy(np.asarray(arrays[key], np.float64))
        for key in ("codes", "noise_map", "flow_forward", "flow_backward")
    )
    for key, array, channels in (("flow_forward", forward, 2), ("flow_backward", backward, 2), ("noise_map", noise, 1)):
        wanted = (len(codes), channels, *codes.shape[-2:])
        if array.ndim != 5 or (len(array), *array.shape[2:]) != wanted or (key != "flow_backward" and not array.size):
            raise ValueError(f"{key} is {[wanted[0], 'frames', *wanted[1:]]}, got {list(array.shape)}")
    length = forward.shape[1] + 1 if outputs is None else outputs + config.look_ahead
    order = reflected(0, length, codes.shape[1])
    images = (codes / 7)[:, order].expand(-1, -1, config.image_channels, -1, -1)
    return images, noise[:, order], Flows(forward, backward)


def recorded(network: FloRNN, images: Tensor, noise: Tensor, flows: Flows) -> dict[str, Tensor]:
    """All stages of a run; those of frame 1 where there is one."""
    ahead, state, decoder = (calls(part) for part in (network.backward_rnn, network.forward_rnn, network.d))
    output = network.restore(images, noise, flows)
    k = network.look_ahead
    result = {
        "ahead_t0": ahead[0][1],
        "splat_t1": ahead[1][0][2],
        "ahead_t1": ahead[1][1],
        "ahead_tk": ahead[k][1],
        "forward_t0": state[0][1],
        "brought_back_t0": decoder[0][0][1],
    }
    if len(state) > 1:
        result |= {"warped_t1": state[1][0][2], "forward_t1": state[1][1], "brought_back_t1": decoder[1][0][1]}
    result = {key: value[:, ::SLICE] for key, value in result.items()} | {"output": output}
    return result | ({"output_t1": output[:, 1]} if len(state) > 1 else {})


def calls(part: nn.Module) -> list[tuple[tuple[Tensor, ...], Tensor]]:
    """A list that gets the inputs and the result of every call."""
    found: list[tuple[tuple[Tensor, ...], Tensor]] = []
    part.register_forward_hook(lambda _part, given, result: found.append((given, result)))
    return found


def small() -> FloRNN:
    """A lively network of the smallest width, with flows of about a pixel."""
    config = FloRNNConfig(
        width=4, blocks=1, look_ahead=2, image_channels=1, flow_channels=(4,), flow_kernel=3, flow_levels=3
    )
    network = fill_by_rule(FloRNN(config)).double().eval()
    assert isinstance(network, FloRNN)
    return network
