"""Merging in batches on any device: equal to plain NumPy and torch (merge_reference.py), and nothing waits."""

import merge_reference as plain
import numpy as np
import pytest
import torch
from merge_windows import EXPOSURE, one_frame, random_sensor, window_of
from operators import Operators

from qsim.sensor.devices import quiver_physical
from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD
from quiver.baselines import path_merge as pm
from quiver.baselines.domain_tables import domain_tables, tables_of_batch
from quiver.baselines.information_domain import information_domain
from quiver.baselines.paths import motion_paths, moved_frames, path_search
from quiver.restoration.merge_inputs import inputs_of_windows, merge_inputs

CPU = torch.device("cpu")


def plain_merge(codes, domain, t):
    """The merged frame t of codes by the plain program."""
    return next(plain.stream(lambda i: codes[i], len(codes), domain, 11, range(t, t + 1)))


@pytest.fixture
def camera_at_rest(monkeypatch):
    """The plain program knows no camera: tests/quiver/baselines/paths/ compare what moves with it."""
    monkeypatch.setattr(motion_paths, "camera_motion", lambda p, offsets: torch.zeros(len(p[2]), len(offsets), 2, 3))


def both(codes, offset, domain):
    """The merged frame and its inputs by the plain program, and by the one that is compared with it."""
    expected = plain_merge(codes, domain, offset)
    found = next(pm.stream(lambda t: codes[t], len(codes), domain, 11, range(offset, offset + 1)))
    inputs = merge_inputs(found, domain_tables(domain, CPU))
    return expected, one_frame(found), plain.merge_inputs(expected, domain), one_frame(inputs)


@pytest.mark.usefixtures("camera_at_rest")
@pytest.mark.parametrize("seed", range(24))
def test_merged_frames_are_those_of_the_plain_program(seed):
    """Over bits, sensors, light, sizes, frames and places in time. Sums of eleven frames are rounded differently."""
    rng = np.random.default_rng(seed)
    sensor = random_sensor(rng)
    shape = (int(rng.integers(1, 13)), int(rng.integers(1, 70)), int(rng.integers(1, 90)))
    codes = window_of(rng, sensor, shape)
    domain = information_domain(sensor, EXPOSURE)
    expected, found, wanted, inputs = both(codes, int(rng.integers(shape[0])), domain)
    top = sensor.levels - 1
    for name in ("mean_code", "alone", "near", "still", "groups"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), abs=1e-5 * top), name
    for name in ("count", "near_count", "group_counts"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=1e-4), name
    assert inputs.deviation == pytest.approx(wanted.deviation.numpy(), rel=2e-4)
    assert np.abs(inputs.channels - wanted.channels.numpy()).max() < 5e-3
    assert np.abs(inputs.channels - wanted.channels.numpy()).mean() < 1e-5


@pytest.mark.parametrize("size", [(96, 104), (40, 200)])
def test_the_search_by_views_is_the_search_by_places(size, monkeypatch):
    """Large frames on a CPU are searched class by class."""
    rng = np.random.default_rng(1)
    frames = torch.from_numpy(rng.normal(size=(2, 7, *size)).astype(np.float32)).cumsum(-1)
    for offsets in (range(-3, 4), range(7), range(-6, 1)):
        monkeypatch.setattr(path_search, "TOGETHER", 1 << 40)
        places = path_search.search(frames, offsets, 8, 18.0)
        monkeypatch.setattr(path_search, "TOGETHER", 0)
        assert torch.equal(path_search.search(frames, offsets, 8, 18.0), places)
        assert places.abs().max() > 1


def test_frames_that_are_followed_in_parts_are_followed_alike(monkeypatch):
    codes = window_of(np.random.default_rng(2), quiver_physical(3.25), (11, 48, 40))
    domain = information_domain(quiver_physical(3.25), EXPOSURE)
    whole = both(codes, 5, domain)[1]
    for module in (moved_frames, pm):
        monkeypatch.setattr(module, "CHUNK", 1)
    assert np.array_equal(both(codes, 5, domain)[1].mean_code, whole.mean_code)


def test_windows_of_a_batch_are_merged_as_if_alone():
    """Of other sensors, bits and light."""
    rng = np.random.default_rng(3)
    sensors = [quiver_physical(3.25), BinarySPAD(0.5, 25.0, 1), QIS(0.8, 1.6, 0.2, 7)]
    codes = [torch.from_numpy(window_of(rng, sensor, (11, 40, 44))) for sensor in sensors]
    domains = [information_domain(sensor, EXPOSURE) for sensor in sensors]
    together = inputs_of_windows(torch.stack(codes), tables_of_batch(domains, CPU))
    for i, (window, domain) in enumerate(zip(codes, domains, strict=True)):
        alone = inputs_of_windows(window[None], domain_tables(domain, CPU))
        assert together.channels[i] == pytest.approx(alone.channels[0], abs=1e-5)
        assert together.phi[i] == pytest.approx(alone.phi[0], abs=1e-5)


@pytest.mark.parametrize("device", ["cpu", "meta"])
def test_a_batch_takes_the_operators_of_a_window_and_waits_for_nothing(device):
    """Tensors without values can answer no question: where something depended on them, the meta device would raise."""
    tables = domain_tables(information_domain(quiver_physical(3.25), EXPOSURE), torch.device(device))

    def merged(codes):
        return pm.merge(pm.prepared(codes, tables), range(-5, 6), tables)

    for run in (lambda codes: inputs_of_windows(codes, tables), merged):
        counts = []
        for batch in (1, 8):
            codes = torch.zeros(batch, 11, 40, 48, dtype=torch.uint8, device=device)
            run(codes)  # makes what is kept for this size
            with Operators() as operators:
                run(codes)
            assert not operators.waits
            counts.append(operators.count)
        assert counts[0] == counts[1]
    with Operators() as one_by_one:
        codes = np.zeros((11, 40, 48), np.uint8)
        plain_merge(codes, information_domain(quiver_physical(3.25), EXPOSURE), 5)
    assert counts[0] < one_by_one.count / 3, (counts, one_by_one.count)  # which looks for no camera


def test_the_count_of_operators_sees_what_waits():
    with Operators() as operators:
        assert float(torch.ones(3).sum()) == 3
    assert operators.waits == ["_local_scalar_dense"]
