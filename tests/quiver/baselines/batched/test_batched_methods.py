"""Classical methods in batches: equal to those that run on a CPU, and nothing waits for the host."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from merge_windows import EXPOSURE, random_sensor, window_of
from operators import Operators

from qsim.keys import Key
from qsim.sensor.devices import quiver_physical
from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD
from quiver.baselines import METHODS, path_merge, qbp
from quiver.baselines.batched import methods
from quiver.baselines.batched import qbp as batched_qbp

CPU = torch.device("cpu")
SUMS = ("naive", "moment")
LOCAL = ("qbp", "qbp-published", "path-merge")
DENOISED = ("transform-denoise", "transform-denoise-published", "qbp-bm3d")


def test_every_method_is_here():
    assert set(methods.METHODS) == set(METHODS) == {*SUMS, "likelihood", *LOCAL, *DENOISED}


def agree(name, found, expected, codes, sensor):
    """Compare frames in the unit in which a method errs: light may hang on the last digit of a mean code."""
    if name in SUMS:
        np.testing.assert_array_equal(found, expected)
        return
    if name == "likelihood":
        np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4 * sensor.white(EXPOSURE))
        return
    response = sensor.response(EXPOSURE)
    seen, wanted = (np.interp(light, response.photons, response.mean) / response.top for light in (found, expected))
    difference = np.abs(seen - wanted)
    if name in LOCAL:
        assert difference.max() < 1e-5
        return
    # Blocks at nearly one distance may change places in their stack, where they touch a few pixels.
    assert difference.max() < 0.02
    assert np.sqrt(np.mean(difference**2)) < 1e-3
    assert np.quantile(difference, 0.9) < 1e-4


@pytest.mark.parametrize("seed", range(6))
def test_frames_are_those_of_the_method_on_a_cpu(seed):
    """Over bits, sensors, light, sizes, lengths, windows, memory and places in time."""
    rng = np.random.default_rng(seed)
    sensor = random_sensor(rng)
    shape = (int(rng.integers(1, 14)), int(rng.integers(1, 50)), int(rng.integers(1, 70)))
    codes = window_of(rng, sensor, shape)
    first = int(rng.integers(shape[0]))
    settings = {"window": int(rng.choice([2, 3, 7, 11])), "frames": range(first, min(shape[0], first + 3))}
    for name, method in METHODS.items():
        expected = method.restore(codes, sensor, EXPOSURE, **settings)
        memory = float(rng.choice([0, 1e8, np.inf]))
        found = methods.restore(codes, sensor, EXPOSURE, method=name, device=CPU, memory=memory, **settings)
        assert found.dtype == np.float32
        assert found.shape == expected.shape
        agree(name, found, expected, codes, sensor)


@pytest.mark.parametrize("settings", [qbp.CALIBRATED, qbp.AS_PUBLISHED])
def test_windows_of_many_bits_are_merged_as_alone(settings):
    """Units of codes follow the light of each window where there are many bits."""
    sensor = QIS(0.8, 1.6, 0.2, 12)
    rng = np.random.default_rng(4)
    light = np.stack([rng.uniform(1, 4, (70, 90)), rng.uniform(100, 900, (70, 90))])
    codes = np.stack([sensor.sample(np.stack([x] * 5), EXPOSURE, key=Key(1, 1), engine="reference") for x in light])
    given = torch.from_numpy(codes.astype(np.float32))
    found = batched_qbp.merge(given, range(-2, 9), sensor, EXPOSURE, settings).numpy()
    for one, window in zip(found, codes, strict=True):
        expected = qbp.merge(window, 3, sensor.response(EXPOSURE), 11, settings)
        np.testing.assert_allclose(one, expected, atol=1e-5 * codes.max())


def test_blocks_of_frames_are_refused():
    with pytest.raises(ValueError, match="blocks of 7 frames are merged on the CPU alone"):
        batched_qbp.merge(torch.zeros(1, 7, 8, 8), range(7), quiver_physical(3.25), EXPOSURE, qbp.Settings(block=7))


def test_codes_of_too_many_bits_for_a_table_of_likelihoods_are_refused():
    with pytest.raises(ValueError, match=r"likelihood: codes of 16 bit need a table of \d+ MB on a GPU"):
        methods.restore(
            np.ones((3, 8, 8), np.uint16),
            QIS(0.8, 1.6, 0.2, 16),
            EXPOSURE,
            method="likelihood",
            device=CPU,
            window=3,
        )


@pytest.mark.parametrize("name", METHODS)
def test_a_sensor_that_tells_no_light_has_the_same_sentence(name):
    sensor = QIS(0.8, 3e7, 0.2, 1)
    codes = np.ones((3, 9, 9), np.uint8)
    errors = []
    for run in (METHODS[name].restore, lambda *given, **more: methods.restore(*given, **more, method=name, device=CPU)):
        try:
            run(codes, sensor, EXPOSURE, window=3)
        except ValueError as error:
            errors.append(str(error))
    assert len(errors) in (0, 2)
    assert len(set(errors)) <= 1


@pytest.mark.parametrize("device", ["cpu", "meta"])
@pytest.mark.parametrize("name", METHODS)
def test_a_batch_waits_for_nothing(name, device):
    """Tensors without values can answer no question: where something depended on them, the meta device would raise."""
    counts = []
    sensor = quiver_physical(3.25)
    for frames in (range(6, 7), range(6, 9)):
        codes = torch.zeros(15, 40, 48, dtype=torch.uint8, device=device)
        given = (codes, sensor, EXPOSURE, METHODS[name].window, frames, np.inf)
        methods.METHODS[name](*given)  # makes what is kept for this sensor and size
        with torch.inference_mode(), Operators() as operators:
            methods.METHODS[name](*given)
        assert not operators.waits
        counts.append(operators.count)
    extra = {"path-merge": 2 * 30}.get(name, 8)  # frames that are pooled one by one; stacked ones
    assert counts[1] <= counts[0] + extra


def test_frames_that_are_merged_together_are_those_that_are_merged_alone():
    sensor = BinarySPAD(0.4, 25.0, 3)
    codes = window_of(np.random.default_rng(8), sensor, (14, 33, 47))
    domain = path_merge.information_domain(sensor, EXPOSURE)
    counts = []
    found = {}
    for together in (1, 3, 100):
        merged = list(path_merge.stream(lambda t: codes[t], 14, domain, 11, range(1, 14), together=together))
        counts.append([len(each.mean_code) for each in merged])
        found[together] = torch.cat([each.mean_code for each in merged])
    assert counts[0] == [1] * 13
    assert counts[1] == [1] * 4 + [3, 1] + [1] * 5
    assert counts[2] == [1] * 4 + [4] + [1] * 5
    for together in (3, 100):
        torch.testing.assert_close(found[together], found[1], rtol=0, atol=1e-5)
