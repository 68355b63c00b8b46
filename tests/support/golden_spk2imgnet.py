"""Records the stages of Spk2ImgNet under the names of its golden file, for golden.py."""

from collections.abc import Mapping

import numpy as np
import torch
from golden import Recorder, fill_by_rule
from torch import Tensor

from quiver.model.published_weights import load_published
from quiver.model.rivals.spk2imgnet import Spk2ImgNet, Spk2ImgNetConfig

INPUTS = ("codes",)
FLAT = True
MULTIPLE = 4


def stages(arrays: Mapping[str, np.ndarray], weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """One run on the ten frames of a window; `ValueError` for another number."""
    codes = np.asarray(arrays["codes"], np.float64)
    network = built(weights)
    if codes.shape[1] != network.frames_in:
        raise ValueError(f"spk2imgnet takes {network.frames_in} frames, got {codes.shape[1]}")
    return recorded(network, torch.from_numpy(codes.reshape(*codes.shape[:2], *codes.shape[-2:]) / 7))


def built(weights: Mapping[str, Tensor]) -> Spk2ImgNet:
    """A float64 network of the port, at the width and depth of the weights."""
    blocks = sum(name.startswith("extractor.net.") and name.endswith("conv1.bias") for name in weights)
    config = Spk2ImgNetConfig(width=len(weights["rec_conv1.bias"]), blocks=blocks, as_published=True)
    network = Spk2ImgNet(config).double().eval()
    load_published(network, weights)
    return network


def recorded(network: Spk2ImgNet, frames: Tensor) -> dict[str, Tensor]:
    """All stages of a window [B, 10, H, W]; features are cut to every n-th channel, as in the file."""
    align = network.pcd_align["pcd_align"]
    calls = Recorder(
        {
            "groups": network.extractor,
            "weights": network.extractor["ca"],
            "aligned": align,
            "gate0": network.mask0,
            "gate4": network.mask4,
            "fusion1": network.rec_conv0,
            "fusion2": network.rec_conv1,
            "offset3": align["L3_dcnpack_1"].conv_offset_mask,
            "cascade": align["cas_dcnpack"].conv_offset_mask,
        }
        | {f"dcn{level}": align[f"L{level}_dcnpack_1"] for level in (1, 2, 3)}
    )
    output, estimates = network.window(frames)
    return {
        "output": output,
        "estimates": estimates,
        "weights_group0": calls["weights"][0],
        "features_group0": calls["groups"][0].features[:, ::4],
        "features_group2": calls["groups"][2].features[:, ::4],
        "offset_mask3_nb0": calls["offset3"][0],
        "dcn3_nb0": calls["dcn3"][0],
        "dcn2_nb0": calls["dcn2"][0][:, ::4],
        "dcn1_nb0": calls["dcn1"][0][:, ::4],
        "offset_mask_cascade_nb0": calls["cascade"][0][:, ::6],
        "aligned0": calls["aligned"][0][:, ::4],
        "aligned4": calls["aligned"][3][:, ::4],
        "gate0": calls["gate0"][0][:, ::8],
        "gate4": calls["gate4"][0][:, ::8],
        "fusion1": calls["fusion1"][0][:, ::12],
        "fusion2": calls["fusion2"][0][:, ::4],
    }


def small() -> Spk2ImgNet:
    """A lively network of the smallest width."""
    network = fill_by_rule(Spk2ImgNet(Spk2ImgNetConfig(width=8, blocks=1))).double().eval()
    assert isinstance(network, Spk2ImgNet)
    return network
