"""Tests noise maps: exact at the nodes of the table, straight between them, from the mean of the pixels around."""

import pytest
import torch
from golden import draw

from quiver.model.rivals.noise import LEAST_VARIANCE, VARIANCE, deviation_map, numbers, table_of, variance_at


def test_the_table_is_read_at_its_nodes_and_between():
    table = torch.tensor(VARIANCE).double()
    nodes = torch.linspace(0, 1, len(VARIANCE), dtype=torch.float64)[None]
    assert (variance_at(nodes, table[None]) - table).abs().max() < 1e-12
    middle = (nodes[:, 1:] + nodes[:, :-1]) / 2
    assert (variance_at(middle, table[None]) - (table[1:] + table[:-1]) / 2).abs().max() < 1e-12
    assert torch.equal(variance_at(torch.tensor([[-3.0, 7.0]]).double(), table[None])[0], table[[0, -1]])


def test_every_clip_reads_its_own_table():
    frames = draw(3, 2, 1, 6, 7)
    tables = torch.rand(3, 9, dtype=torch.float64)
    together = deviation_map(frames, table_of(tables, frames))
    for i in range(3):
        alone = deviation_map(frames[i : i + 1], table_of(tables[i], frames[i : i + 1]))
        assert (together[i] - alone[0]).abs().max() < 1e-12


def test_half_precision_reads_the_table_exactly():
    frames = torch.tensor([[0.3]], dtype=torch.bfloat16)
    table = table_of(torch.linspace(0, 1, 1025), frames)
    assert table.dtype == torch.float32
    assert float(variance_at(frames, table)) == pytest.approx(float(frames), abs=1e-6)


def test_the_deviation_is_that_of_the_mean_around_a_pixel():
    table = torch.tensor([0.0, 0.5, 2.0])
    frames = draw(2, 3, 1, 9, 8)
    found = deviation_map(frames, table_of(table, frames))
    inner = frames[1, 2, 0, 2:7, 1:6].mean()
    corner = frames[0, 0, 0, :3, :3].mean()
    for mean, deviation in ((inner, found[1, 2, 0, 4, 3]), (corner, found[0, 0, 0, 0, 0])):
        wanted = (mean if mean < 0.5 else 3 * mean - 1) ** 0.5  # 0 to 0.5 to 2
        assert deviation == pytest.approx(float(wanted), rel=1e-6)


def test_no_light_leaves_a_finite_slope():
    frames = torch.zeros(1, 1, 1, 5, 5, requires_grad=True)
    deviation = deviation_map(frames, torch.tensor([[0.0, 1.0]]))
    deviation.sum().backward()
    assert float(deviation.detach().max()) == pytest.approx(LEAST_VARIANCE**0.5)
    assert frames.grad.isfinite().all()


@pytest.mark.parametrize("shape", [(), (1,), (3, 9), (2, 1), (1, 2, 3)])
def test_other_tables_are_refused(shape):
    with pytest.raises(ValueError, match=r"^variance must be a table \[n\] or one for each of 2 clips \[2, n\]"):
        table_of(torch.zeros(shape), torch.zeros(2, 1, 1, 4, 4))


@pytest.mark.parametrize("values", [(0.1,), 3, (0.1, -1.0), (0.1, float("nan")), "ab"])
def test_other_numbers_are_refused(values):
    with pytest.raises(ValueError, match="noise must be"):
        numbers("noise", values, 2, 2)
    assert numbers("noise", [0, 0.5], 2, 2) == (0, 0.5)
