"""Records the stages of EMVD under the names of its golden file, for golden.py."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from golden import Recorder, fill_by_rule
from torch import Tensor

from quiver.model.published_weights import load_published
from quiver.model.rivals.emvd import EMVD, EMVDConfig
from quiver.model.rivals.noise import table_of

INPUTS = ("codes", "noise_ab")
MULTIPLE = 8
COLOUR = [[0.5, 0.5, 0.5, 0.5], [-0.5, 0.5, 0.5, -0.5], [0.65, 0.2784, -0.2784, -0.65], [-0.2784, 0.65, -0.65, 0.2764]]
HAAR = np.array([[1, 1], [1, -1]]) / np.sqrt(2)
START = {
    "ct.net1.weight": COLOUR,
    "cti.net1.weight": np.transpose(COLOUR),
    "ft.net1.weight": HAAR,
    "fti.net1.weight": HAAR[0],
    "fti.net2.weight": HAAR[1],
}
PUBLISHED = EMVDConfig(as_published=True)


def stages(arrays: Mapping[str, np.ndarray], weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """One run with the noise constants of the file, one with those of the port."""
    width = len(weights["refine.net1.weight"])
    noise = np.asarray(arrays.get("noise_ab", PUBLISHED.published_noise))
    if noise.shape != (2,) or noise.dtype.kind not in "iuf":
        raise ValueError(f"noise_ab is the slope and the offset of the noise, got {noise.dtype} {list(noise.shape)}")
    slope, offset = (float(value) for value in noise)
    result = recorded(built(replace(PUBLISHED, width=width, published_noise=(slope, offset)), weights), arrays["codes"])
    output, _ = run(built(replace(PUBLISHED, width=width), weights), arrays["codes"])
    return {**result, "output_published_ab": output[:, -1]}


def built(config: EMVDConfig, weights: Mapping[str, Tensor]) -> EMVD:
    """A float64 network with published weights."""
    network = EMVD(config).double().eval()
    load_published(network, weights)
    return network


def run(network: EMVD, codes: np.ndarray) -> tuple[Tensor, Tensor]:
    """Codes [B, T, 1, H, W] -> outputs and states [B, T, 4, H, W]."""
    images = network.packed(torch.from_numpy(np.asarray(codes, np.float64) / 7))
    table = table_of(None, images)
    state = None
    outputs = []
    states = []
    for image in images.unbind(1):
        output, state = network.step(state, image, table)
        outputs.append(output)
        states.append(state)
    return torch.stack(outputs, dim=1), torch.stack(states, dim=1)


def recorded(network: EMVD, codes: np.ndarray) -> dict[str, Tensor]:
    """All stages of a run; `_t2` are those of frame 2, where there is one."""
    calls = Recorder(
        {
            "bands": network.ft,
            "image": network.fti,
            "2": network.vd,
            "1": network.md1,
            "0": network.md0,
            "omega": network.refine,
        }
    )
    output, states = run(network, codes)
    result = {"output": output, "state": states}
    if codes.shape[1] < 3:
        return result
    # 6 and 4 calls per frame
    old = calls["bands"][12:15]
    new = calls["bands"][15:18]
    images = calls["image"][8:12]
    result |= {"haar0_old_t2": old[0], "up2_t2": images[0], "omega_t2": calls["omega"][2]}
    for scale in range(3):
        fused = calls[str(scale)][2]
        result |= {
            f"haar{scale}_new_t2": new[scale],
            f"gamma{scale}_t2": fused.gamma,
            f"fused{scale}_t2": fused.fused,
            f"var{scale}_t2": fused.variance,
            f"denoised{scale}_t2": fused.denoised,
        }
    return result | {"denoised_t2": network.cti(network.fti(result["denoised0_t2"]))}


def small() -> EMVD:
    """A lively network of the smallest width."""
    network = fill_by_rule(EMVD(EMVDConfig(width=2))).double().eval()
    assert isinstance(network, EMVD)
    return network
