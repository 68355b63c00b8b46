"""Tests Adam and Muon: the weights that each updates, the size of a step, and kernels as matrices."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from quiver.model.unet import UNet, UNetConfig
from quiver.training.optimiser import Optimiser

RATE = 0.01


def network() -> UNet:
    """Return a U-Net with gradients of singular values from 1 to 100 in every kernel."""
    torch.manual_seed(0)
    unet = UNet(UNetConfig(8))
    for weight in unet.parameters():
        gradient = torch.randn_like(weight).flatten(1) if weight.ndim > 1 else torch.randn_like(weight)
        if weight.ndim > 1:
            u, s, v = torch.linalg.svd(gradient, full_matrices=False)
            gradient = u @ torch.diag(torch.logspace(0, 2, len(s))) @ v
        weight.grad = gradient.view(weight.shape)
    return unet


def steps(unet: UNet, kind: str) -> dict[str, torch.Tensor]:
    before = {name: weight.detach().clone() for name, weight in unet.named_parameters()}
    Optimiser(unet, kind, RATE, (0.9, 0.99)).step(RATE)  # type: ignore[arg-type]
    return {name: weight.detach() - before[name] for name, weight in unet.named_parameters()}


def check_first_step_of_adam(unet: UNet, name: str, step: torch.Tensor) -> None:
    """Assert a step of -rate * g / (|g| + 1e-8) for the gradient g.

    rtol covers float32: a rounding of 6e-8 in the difference of weights below 1 is 6e-6 of the step.
    """
    gradient = unet.get_parameter(name).grad
    assert gradient is not None
    expected = -RATE * gradient.double() / (gradient.double().abs() + 1e-8)
    np.testing.assert_allclose(step.numpy(), expected.numpy(), rtol=2e-5, err_msg=name)


def test_adam_moves_every_weight_by_the_rate():
    unet = network()
    for name, step in steps(unet, "adam").items():
        check_first_step_of_adam(unet, name, step)


def test_muon_moves_every_direction_of_a_kernel_alike():
    """The step is the polar factor of the gradient, here by singular values, in the size of a step of Adam."""
    unet = network()
    inner = 0
    for name, step in steps(unet, "muon").items():
        if step.ndim < 2 or "leave" in name:
            check_first_step_of_adam(unet, name, step)
            continue
        inner += 1
        gradient = unet.get_parameter(name).grad
        assert gradient is not None
        u, _, v = torch.linalg.svd(gradient.flatten(1), full_matrices=False)
        strengths = torch.diag(u.T @ -step.flatten(1) @ v.T) / (0.2 * RATE * max(gradient.flatten(1).shape) ** 0.5)
        # five iterations give 0.7 to 1.2 for singular values above 1/500 of the norm
        assert 0.6 < strengths.min() <= strengths.max() < 1.25, name
    assert inner > 10


@pytest.mark.parametrize("kind", ["adam", "muon"])
def test_a_weight_without_gradient_stays(kind):
    unet = network()
    unet.body.bottom.requires_grad_(False)
    for weight in unet.body.merge1.parameters():
        weight.grad = None
    for name, step in steps(unet, kind).items():
        assert bool(step.any()) != ("bottom" in name or "merge1" in name), name


def test_kernels_that_are_no_matrices_are_refused():
    """Muon would otherwise update a copy of them."""
    unet = network().to(memory_format=torch.channels_last)
    with pytest.raises(ValueError, match=r"body\..*weight: Muon sees kernels as matrices"):
        steps(unet, "muon")
    steps(unet, "adam")


def test_another_optimisers_state_is_refused():
    adam, muon = (Optimiser(network(), kind, RATE, (0.9, 0.99)) for kind in ("adam", "muon"))
    with pytest.raises(ValueError, match="another optimiser"):
        muon.load_state_dict(adam.state_dict())
