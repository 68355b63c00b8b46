"""Records the stages of RVRT under the names of its golden file, for golden.py."""

from collections.abc import Mapping

import numpy as np
import torch
from golden import Recorder, fill_by_rule
from torch import Tensor

from quiver.model.published_weights import load_published
from quiver.model.rivals.rvrt import CLIP, PASSES, QUARTER, RVRT, RVRTConfig, reduced

INPUTS = ("codes",)
MULTIPLE = QUARTER


def stages(arrays: Mapping[str, np.ndarray], weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """One run; a single clip of two frames is never aligned and has fewer stages.

    `ValueError` for an odd clip, and for frames so small that the coarsest flow of the port has one pixel.
    """
    count = arrays["codes"].shape[1]
    height, width = arrays["codes"].shape[-2:]
    if count % CLIP:
        raise ValueError(f"rvrt takes an even number of frames, got {count}")
    network = built(weights)
    if min(height, width) < network.least:
        raise ValueError(f"rvrt takes frames whose sides are at least {network.least} px, got {height} x {width}")
    return recorded(network, torch.from_numpy(np.asarray(arrays["codes"], np.float64) / 7))


def built(weights: Mapping[str, Tensor]) -> RVRT:
    """A float64 network with published weights, of their width and levels."""
    width = len(weights["feat_extract.1.weight"])
    levels = len({name.split(".")[2] for name in weights if name.startswith("spynet.basic_module.")})
    network = RVRT(RVRTConfig(width=width, flow_levels=levels)).double().eval()
    load_published(network, weights)
    return network


def recorded(network: RVRT, frames: Tensor) -> dict[str, Tensor]:
    """All stages of a run on frames [B, T, 1, H, W], T even."""
    main = network.backbone["backward_1"].main
    layers = list(main["5"][0].residual_group["blocks"])
    align = network.deform_align["backward_1"]
    last = network.deform_align["forward_2"]
    calls = Recorder(
        {
            "flow": network.spynet,
            "ln": main["3"],
            "layer0": layers[0],
            "layer1": layers[1],
            "block0": main["5"][0],
            "stack": network.backbone["backward_1"],
            "raw": align.conv_offset,
            "align": align,
            "last": last,
            "reconstruction": network.reconstruction,
        }
    )
    seen: list[Tensor] = []
    hook = align.conv_offset.register_forward_pre_hook(lambda _module, inputs: seen.append(inputs[0]))
    features = network.features(frames)
    output = frames + network.rebuilt(features)
    hook.remove()
    pairs = (frames.shape[0], frames.shape[1] - 1)
    result = {
        "small_t0": reduced(frames[:, 0]),
        "flow_to_next": calls["flow"][0].unflatten(0, pairs),
        "flow_to_previous": calls["flow"][1].unflatten(0, pairs),
        "stack_backward_1_first": calls["stack"][0][:, :, ::24],
        "reconstruction": torch.cat(calls["reconstruction"], dim=1)[:, :, ::24],
        "output": output,
        "output_last": output[:, -1],
    }
    result |= {f"feat_{name}": features[name][:, :, ::12] for name in ("shallow", *PASSES)}
    for key in ("ln", "layer0", "layer1", "block0"):
        result[f"stack_backward_1_first_{key}"] = calls[key][0].movedim(-1, 2)[:, :, ::24]
    return result | (aligned(calls, seen[0], network.config.width) if seen else {})


def aligned(calls: Recorder, seen: Tensor, width: int) -> dict[str, Tensor]:
    """Stages of the first alignment; `seen` [B*2, 3C + 4, h, w] is the input of its offset network."""
    seen = seen.unflatten(0, (-1, CLIP))
    result, guides = calls["align"][0]
    return {
        "compose_A": seen[:, :, -4:-2],
        "compose_B": seen[:, :, -2:],
        "warped_A": seen[:, :, width : 2 * width : 24],
        "warped_B": seen[:, :, 2 * width : 3 * width : 24],
        "offset_raw_backward_1": calls["raw"][0].unflatten(0, (-1, CLIP))[:, :, ::18],
        "align_backward_1_first": result[:, :, ::12],
        "align_backward_1_flowA": guides.straight,
        "align_backward_1_flowB": guides.crossed,
        "align_forward_2_last": calls["last"][-1][0][:, :, ::12],
    }


def beginning(codes: np.ndarray, weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The stages up to the first alignment, from the frames that they need alone, for a quick test."""
    network = built(weights)
    frames = torch.from_numpy(np.asarray(codes, np.float64) / 7)
    last = frames[:, -2 * CLIP :]
    shallow = network.shallow(last.flatten(0, 1)).unflatten(0, last.shape[:2])
    steps = network.flows(last)[0].flip(1)
    features, guides = network.passed("backward_1", {"shallow": shallow.flip(1)}, steps, None)
    assert guides[1] is not None
    return {
        "small_t0": reduced(frames[:, 0]),
        "stack_backward_1_first": features[:, :CLIP, ::24],
        "align_backward_1_flowA": guides[1].straight,
        "align_backward_1_flowB": guides[1].crossed,
    }


def small() -> RVRT:
    """A lively network of the smallest width."""
    network = fill_by_rule(RVRT(RVRTConfig(width=6, flow_levels=1))).double().eval()
    assert isinstance(network, RVRT)
    return network
