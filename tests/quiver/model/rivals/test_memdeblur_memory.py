"""The memory of MemDeblur: attention as a plain sum, what is kept, sizes that do not divide."""

import math

import pytest
import torch
from golden import draw, fill_by_rule

from quiver.model.rivals.memdeblur import FEATURES, KEPT, NEAREST, Attention, Memory, Stored


def drawn(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(sum(shape)))


@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize("count", [1, NEAREST, 33])
def test_a_read_is_a_weighted_sum_over_the_nearest_entries(count, training):
    """The affinity (2 k.q - |k|^2)/sqrt(width) is the negative squared distance but for a constant."""
    stored = Stored(drawn(2, 8, count), drawn(2, 5, count))
    query = drawn(2, 8, 3, 2)
    read = Attention().train(training)(stored, query)
    for b, y, x in ((0, 0, 0), (1, 2, 1)):
        distances = (stored.keys[b] - query[b, :, y, x, None]).square().sum(dim=0) / math.sqrt(8)
        limit = distances.max() if training else distances.sort().values[min(count, NEAREST) - 1]
        weights = torch.exp(-distances) * (distances <= limit)
        assert torch.allclose(read[b, :, y, x], stored.values[b] @ (weights / weights.sum()), atol=1e-12)


def test_a_memory_keeps_the_latest_entries_in_the_unit_of_the_last_key():
    memory = Memory(8, group_norm=False).eval()
    sizes = [(4, 4), (1, 2), (1, 2), (3, 1)]
    stored = None
    wanted = 0
    for number, size in enumerate(sizes):
        key = torch.full((1, 8, *size), float(number))
        stored = memory.write(stored, key, key[:, :5])
        wanted = 16 if number == 0 else min(wanted + size[0] * size[1], KEPT * size[0] * size[1])
        assert stored.keys.shape == (1, 8, wanted)
        assert stored.values.shape == (1, 5, wanted)
        assert stored.keys[0, 0, -1] == number
        assert (stored.keys[0, 0].diff() >= 0).all()
    stored = memory.train().write(stored, torch.zeros(1, 8, 1, 1), torch.zeros(1, 5, 1, 1))
    assert stored.keys.shape[2] == wanted + 1


@pytest.mark.parametrize("group_norm", [False, True])
def test_keys_and_values_have_a_quarter_of_the_size_and_return(group_norm):
    memory = fill_by_rule(Memory(8, group_norm)).double().eval()
    feature = draw(2, FEATURES, 7, 9)
    with torch.no_grad():
        key = memory.key(feature)
        value = memory.value_encoder_mem(draw(2, 2 * FEATURES, 7, 9))
        assert key.shape == (2, 8, 2, 3)
        assert value.shape == (2, 32, 2, 3)
        read = memory.read(memory.write(None, key, value), key)
        decoded = memory.decode_image(read, feature), memory.decode_feature(read, feature)
    assert all(x.shape == (2, 8, 7, 9) for x in decoded)
    assert not torch.equal(*decoded)


def test_keys_begin_orthogonal():
    weight = Memory(8, group_norm=False).key_proj["key_proj"].weight.flatten(1)
    assert torch.allclose(weight @ weight.mT, torch.eye(8), atol=1e-5)
