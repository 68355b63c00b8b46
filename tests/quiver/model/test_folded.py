"""Tests the initial weights of FoldedQUIVER: about the mean of the middle frames, and features that vary."""

from dataclasses import replace

import pytest
import torch
from golden import FOLDED, draw
from torch import Tensor

from quiver.model.presets import assemble, build


def test_an_untrained_nano_returns_about_the_mean_of_the_middle_frames():
    """On a static window the random layers add less than a fifth of the noise of one frame (rms)."""
    torch.manual_seed(0)
    network, x = build("nano"), draw(1, 1, 1, 32, 32, dtype=torch.float32).repeat(1, 11, 1, 1, 1)
    with torch.no_grad():
        out = network(x).scale1[:, 0]
    weights = network.estimate.weights.detach()
    assert float(weights.sum()) == pytest.approx(1)
    mean = torch.einsum("btchw,t->bchw", x, weights)
    assert float((out - mean).square().mean()) < 0.04 * float(x.var())


def test_the_lecun_start_keeps_the_fused_features_alive():
    """Standard deviation over space, sum of four starts: with default weights the gate multiplies two weak signals."""
    x, spread = draw(1, 11, 1, 32, 32, dtype=torch.float32), {False: 0.0, True: 0.0}
    for lecun in (False, True):
        for seed in range(4):
            torch.manual_seed(seed)
            started = assemble(replace(FOLDED, lecun=lecun))
            fused: list[Tensor] = []
            started.fusions[0].register_forward_hook(lambda _m, _i, out, fused=fused: fused.append(out))
            with torch.no_grad():
                started(x)
            spread[lecun] += float(fused[1].flatten(2).std(dim=2).mean())
    assert spread[True] > 10 * spread[False], spread
