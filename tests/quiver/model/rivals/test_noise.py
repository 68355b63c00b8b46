"""Tests noise maps: exact at the nodes of the table, straight between them, from the mean of the pixels around."""

import pytest
import torch
from golden import draw

from quiver.model.rivals.noise import LEAST_VARIANCE, VARIANCE, deviation_map, variance_at, variance_table


def test_the_table_is_read_at_its_nodes_and_between():
    table = torch.tensor(VARIANCE).double()
    nodes = torch.linspace(0, 1, len(VARIANCE), dtype=torch.float64)
    assert (variance_at(nodes, table) - table).abs().max() < 1e-12
    middle = (nodes[1:] + nodes[:-1]) / 2
    assert (variance_at(middle, table) - (table[1:] + table[:-1]) / 2).abs().max() < 1e-12
    assert torch.equal(variance_at(torch.tensor([-3.0, 7.0]).double(), table), table[[0, -1]])


def test_the_deviation_is_that_of_the_mean_around_a_pixel():
    table, frames = torch.tensor([0.0, 0.5, 2.0]), draw(2, 3, 1, 9, 8)
    found = deviation_map(frames, table)
    inner, corner = frames[1, 2, 0, 2:7, 1:6].mean(), frames[0, 0, 0, :3, :3].mean()
    for mean, deviation in ((inner, found[1, 2, 0, 4, 3]), (corner, found[0, 0, 0, 0, 0])):
        wanted = (mean if mean < 0.5 else 3 * mean - 1) ** 0.5  # 0 to 0.5 to 2
        assert deviation == pytest.approx(float(wanted), rel=1e-6)


def test_no_light_leaves_a_finite_slope():
    frames = torch.zeros(1, 1, 1, 5, 5, requires_grad=True)
    deviation = deviation_map(frames, torch.tensor([0.0, 1.0]))
    deviation.sum().backward()
    assert float(deviation.detach().max()) == pytest.approx(LEAST_VARIANCE**0.5)
    assert frames.grad.isfinite().all()


@pytest.mark.parametrize("values", [(0.1,), 3, (0.1, -1.0), (0.1, float("nan")), "ab"])
def test_other_tables_are_refused(values):
    with pytest.raises(ValueError, match="variance must be"):
        variance_table("variance", values)
    assert variance_table("variance", [0, 0.5]) == (0, 0.5)
