"""Compares every stage of QUIVER with numbers of the published network, for weights by rule."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from golden import DATA, beyond, network, published_state, rule, terms_of
from golden_quiver import recorded
from machines import walk

from quiver.model.published_weights import from_published

TABLE = DATA / "published_state_dict.tsv"


@pytest.fixture(scope="module")
def golden() -> dict[str, np.ndarray]:
    with np.load(DATA / "golden_quiver_c16.npz") as file:
        return dict(file)


def errors(ours: dict[str, torch.Tensor], golden: dict[str, np.ndarray]) -> dict[str, float]:
    """Return max |ours - golden| / std(golden) of every key."""
    assert ours.keys() == golden.keys() - {"codes"}
    result = {}
    for key, tensor in ours.items():
        assert tensor.shape == golden[key].shape, key
        wanted = golden[key].astype(np.float64)
        result[key] = float(np.abs(tensor.double().numpy() - wanted).max() / wanted.std())
    return result


def test_the_rule_gives_the_weights_of_the_specification():
    weight = rule("spatial_att.conv.weight", (704, 704, 3, 3))
    np.testing.assert_allclose(weight.ravel()[:3], [-0.00765037816, -0.00771230133, -0.00067661627], rtol=1e-6)
    assert weight.sum(dtype=np.float64) == pytest.approx(-5.02891367, abs=1e-5)
    bias = rule("pa_deform.conv_offset.6.bias", (432,))
    np.testing.assert_allclose(bias[:3], [-0.0906331688, -0.00527061475, -0.0768369883], rtol=1e-6)


def test_every_stage_equals_the_published_network_in_float32(golden):
    """The rule also separates the exact GELU from its tanh approximation, which differs by 6e-4 at `tca`."""
    found = errors(recorded(from_published(published_state()), golden["codes"]), golden)
    assert not beyond(found, golden, TABLE, np.float32)
    assert walk(terms_of(TABLE), np.float32) < 6e-4 / 3


@pytest.mark.slow
def test_every_stage_equals_the_published_network_in_float64(golden):
    found = errors(recorded(from_published(published_state()).double(), golden["codes"]), golden)
    assert not beyond(found, golden, TABLE)


@dataclass(frozen=True)
class Summary:
    """Mean, standard deviation and last element of an array of the published network, float64."""

    shape: tuple[int, ...]
    mean: float
    std: float
    last: float


# Sizes that are not multiples of 32, two clips in a batch, 13 frames.
CASE_A = {
    "denoised": Summary((2, 13, 1, 36, 44), 0.4965304603, 0.4525002964, 0.3631571475),
    "flow1": Summary((24, 2, 36, 44), 0.3458710136, 0.8654593401, -0.5263080308),
    "flow2": Summary((24, 2, 18, 22), 0.0987066744, 0.3898696418, -0.2809293742),
    "flow4": Summary((24, 2, 9, 11), 0.0222045350, 0.1521494432, -0.1352027185),
    "dcn_first": Summary((2, 16, 36, 44), -0.0201653392, 0.1882921525, -0.0147875754),
    "state_t5": Summary((2, 32, 9, 11), -0.0138733440, 0.2821473595, 0.2800447712),
    "tca": Summary((2, 64, 9, 11), 0.0132001510, 0.2547212027, -0.2083796999),
    "out4": Summary((2, 3, 1, 9, 11), -0.0677389323, 0.0227913473, -0.0488322691),
    "out2": Summary((2, 3, 1, 18, 22), -0.0511396432, 0.0162652916, -0.0305866918),
    "out1": Summary((2, 3, 1, 36, 44), -0.0209870157, 0.0175746591, -0.0058943731),
}
# Four channels in each deformable group.
CASE_B = {
    "denoised": Summary((1, 11, 1, 32, 32), 0.0590104579, 0.4332943623, 0.2382229363),
    "flow1": Summary((10, 2, 32, 32), 0.4134338407, 1.4150452001, -0.9606242688),
    "flow2": Summary((10, 2, 16, 16), 0.0728769613, 0.6334736962, -0.5157470186),
    "flow4": Summary((10, 2, 8, 8), 0.0058849750, 0.2510804237, -0.2425042577),
    "dcn_first": Summary((1, 64, 32, 32), 0.0118800634, 0.1365732874, 0.0457076366),
    "state_t5": Summary((1, 128, 8, 8), 0.0288437613, 0.2812187236, 0.1215932479),
    "tca": Summary((1, 256, 8, 8), 0.0080702097, 0.2643561117, -0.0291102423),
    "out4": Summary((1, 1, 1, 8, 8), -0.0403484718, 0.0203745928, -0.0080055862),
    "out2": Summary((1, 1, 1, 16, 16), -0.0175082001, 0.0082256050, -0.0153690593),
    "out1": Summary((1, 1, 1, 32, 32), 0.0091161844, 0.0067716386, 0.0139698158),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("channels", "seed", "shape", "wanted"),
    [(16, 11, (2, 13, 1, 36, 44), CASE_A), (64, 12, (1, 11, 1, 32, 32), CASE_B)],
    ids=["odd-sizes-two-clips-thirteen-frames", "full-width"],
)
def test_other_sizes_and_widths_equal_the_published_network(channels, seed, shape, wanted):
    """The published numbers have ten digits, which allows 2e-8 of the standard deviation."""
    codes = np.random.default_rng(seed).integers(0, 8, shape)
    found = recorded(network(channels, torch.float64), codes)
    for key, summary in wanted.items():
        array = found[key].numpy()
        assert array.shape == summary.shape, key
        ours = np.array([array.mean(), array.std(), array.ravel()[-1]])
        wanted_values = np.array([summary.mean, summary.std, summary.last])
        assert np.abs(ours - wanted_values).max() < 2e-8 * summary.std, (key, ours - wanted_values)
