"""Functions read from tables on a device: against NumPy's interpolation, in batches, at both ends."""

import numpy as np
import pytest
import torch
from merge_windows import EXPOSURE, random_sensor

from qsim.sensor.devices import quiver_physical
from quiver.baselines.curves import curves, joined
from quiver.baselines.domain_tables import CODE_BITS, domain_tables, tables_of_batch
from quiver.baselines.information_domain import FLOOR, information_domain

CPU = torch.device("cpu")


def places(low, high, rng):
    """Numbers all over a range, dense at its ends, at them, and beyond."""
    near = (high - low) * 10 ** rng.uniform(-6, -0.3, 4000)
    return np.concatenate(
        [rng.uniform(low, high, 4000), low + near, high - near, [low, high, (low + high) / 2, low - 0.5, high + 0.5]]
    ).astype(np.float32)


def test_a_line_is_read_exactly_and_ends_at_its_ends():
    x = np.array([0.25, 3.0])
    table = curves(x, [np.array([1.0, 12.0]), np.array([5.0, -6.0])], CODE_BITS, CPU)
    at = places(0.25, 3.0, np.random.default_rng(0))
    place = table.place(torch.from_numpy(at)[None])
    expected = 4 * at.clip(0.25, 3)
    assert table.value(place, 0)[0].numpy() == pytest.approx(expected, rel=3e-7)
    assert table.value(place, 1)[0].numpy() == pytest.approx(6 - expected, abs=2e-6)


def test_a_range_of_a_power_of_two_has_a_middle():
    """Half of the range then is an octave's end, also where the range is shorter by less than a float tells."""
    for low in (0.0, 9e-12):
        table = curves(np.array([low, 1.0]), [np.array([low, 1.0])], CODE_BITS, CPU)
        at = torch.tensor([[0.5, np.nextafter(np.float32(0.5), 0), np.nextafter(np.float32(0.5), 1)]])
        assert table.value(table.place(at), 0)[0].numpy() == pytest.approx(at[0].numpy(), rel=1e-6)


@pytest.mark.parametrize("seed", range(12))
def test_tables_on_a_device_are_those_of_numpy(seed):
    """phi within 2e-5, a fifteen-thousandth of the noise of a code; variance within 0.1 %; light within 1e-5 of white
    beyond what one float of phi means.
    """
    rng = np.random.default_rng(300 + seed)
    sensor = random_sensor(rng)
    domain = information_domain(sensor, EXPOSURE)
    tables = domain_tables(domain, CPU)
    at = places(domain.mean_code[0], domain.mean_code[-1], rng)
    given = torch.from_numpy(at)[None, None]
    assert tables.phi(given)[0, 0].numpy() == pytest.approx(domain.forward(at), abs=2e-5)
    variance = np.maximum(np.interp(at, domain.mean_code, domain.variance), FLOOR)
    assert tables.variance(given)[0, 0].numpy() == pytest.approx(variance, rel=1e-3)
    phi = places(0, domain.phi[-1], rng)
    step = np.spacing(np.float32(domain.phi[-1]))
    around = [domain.inverse(phi + move) for move in (-step, step)]
    found = tables.photons(torch.from_numpy(phi)[None, None])[0, 0].numpy()
    slack = 1e-5 * sensor.white(EXPOSURE)
    assert (found >= around[0] - slack).all()
    assert (found <= around[1] + slack).all()


@pytest.mark.parametrize("bits", [1, 3, 8])
def test_phi_of_pooled_codes_is_exact(bits):
    domain = information_domain(quiver_physical(3.25, bits), EXPOSURE)
    tables = domain_tables(domain, CPU)
    rng = np.random.default_rng(bits)
    for scale in (8, 4, 2):
        pooled = (rng.integers(0, scale**2 * domain.top + 1, (1, 5, 7)) / scale**2).astype(np.float32)
        found = tables.phi_of_pooled(torch.from_numpy(pooled), scale)
        assert np.array_equal(found.numpy(), domain.forward(pooled))


def test_windows_of_a_batch_have_their_own_tables():
    rng = np.random.default_rng(5)
    domains = [information_domain(random_sensor(np.random.default_rng(s)), EXPOSURE) for s in (1, 2, 3)]
    codes = torch.from_numpy(np.stack([rng.uniform(0, x.mean_code[-1], (4, 6)) for x in domains]).astype(np.float32))
    together = tables_of_batch(domains, CPU)
    pooled = torch.stack([torch.full((4, 6), x.top / 2) for x in domains])
    for i, domain in enumerate(domains):
        alone = domain_tables(domain, CPU)
        one = codes[i : i + 1]
        assert torch.equal(together.phi(codes)[i], alone.phi(one)[0])
        assert torch.equal(together.variance(codes)[i], alone.variance(one)[0])
        assert torch.equal(together.photons(codes)[i], alone.photons(one)[0])
        assert torch.equal(together.phi_of_pooled(pooled, 2)[i], alone.phi_of_pooled(pooled[i : i + 1], 2)[0])
    assert tables_of_batch(domains[:1] * 3, CPU) is domain_tables(domains[0], CPU)


def test_joined_tables_keep_their_places():
    parts = [curves(np.array([0.0, n]), [np.array([0.0, n * n])], CODE_BITS, CPU) for n in (1.0, 2.0, 7.0)]
    at = torch.tensor([[0.5], [0.5], [0.5]])
    table = joined(parts)
    assert table.value(table.place(at), 0).flatten().tolist() == pytest.approx([0.5, 1.0, 3.5], rel=1e-6)
