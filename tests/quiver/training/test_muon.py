"""Tests Muon against torch's, which computes in bfloat16 and one matrix after another."""

import pytest
import torch

from quiver.training.muon import Muon, polar_factors

RATE = 0.01


def matrices(seed: int) -> list[torch.nn.Parameter]:
    """Return matrices, some of one shape, wide, tall and thin."""
    torch.manual_seed(seed)
    shapes = [(16, 144), (16, 144), (40, 8), (24, 24), (1, 30), (9, 1), (16, 144)]
    return [torch.nn.Parameter(torch.randn(shape)) for shape in shapes]


@pytest.mark.parametrize("seed", range(4))
def test_steps_are_those_of_torch(seed):
    """Over successive gradients, of which some are missing; bfloat16 has eight bits."""
    ours = matrices(seed)
    theirs = matrices(seed)
    start = [matrix.detach().clone() for matrix in ours]
    optimisers = (
        Muon(ours, RATE),
        torch.optim.Muon(theirs, lr=RATE, weight_decay=0.0, adjust_lr_fn="match_rms_adamw"),
    )
    for _ in range(5):
        for our, their in zip(ours, theirs, strict=True):
            gradient = torch.randn_like(our) * 10 ** float(torch.empty(()).uniform_(-3, 3))
            our.grad = None if torch.rand(()) < 0.2 else gradient
            their.grad = our.grad
        for optimiser in optimisers:
            optimiser.step()
    for our, their, before in zip(ours, theirs, start, strict=True):
        assert (our - their).norm() < 0.03 * (our - before).norm()
        assert (our - before).norm() > 0


def test_polar_factors_have_the_directions_of_their_matrices():
    torch.manual_seed(1)
    for shape in ((3, 20, 50), (3, 50, 20)):
        given = torch.randn(shape)
        u, _, v = torch.linalg.svd(given, full_matrices=False)
        strengths = u.mT @ polar_factors(given) @ v.mT
        along = strengths.diagonal(dim1=1, dim2=2)
        assert 0.6 < along.min() <= along.max() < 1.25
        assert (strengths - torch.diag_embed(along)).abs().max() < 1e-4


def test_no_gradient_is_no_step_and_zero_stays_zero():
    matrix = torch.nn.Parameter(torch.ones(3, 4))
    optimiser = Muon([matrix], RATE)
    optimiser.step()
    matrix.grad = torch.zeros(3, 4)
    optimiser.step()
    assert torch.equal(matrix.detach(), torch.ones(3, 4))


def test_a_closure_is_refused():
    with pytest.raises(TypeError, match="Muon calls no closure"):
        Muon([torch.nn.Parameter(torch.ones(2, 2))], RATE).step(lambda: 0.0)
