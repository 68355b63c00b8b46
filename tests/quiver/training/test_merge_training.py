"""Training of MergeNet: inputs of a window, the table from phi to light, and a loss in decibels."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from merge_windows import random_sensor, window_of
from operators import Operators
from torch.utils.data import default_collate

from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD
from quiver.baselines.information_domain import information_domain
from quiver.data.codes import array_codes
from quiver.data.sensor_of_window import SENSORS, TOP, SeenBy, seen_by
from quiver.data.windows import as_input
from quiver.model.mergenet import MergeNet, MergeNetConfig
from quiver.model.presets import build
from quiver.model.unet import UNet
from quiver.training import merge_training as mt
from quiver.training import system as training_system
from quiver.training.loop import train
from quiver.training.settings import Settings
from quiver.training.system import collated
from quiver.training.systems import SYSTEMS, system_of

EXPOSURE = 5e-4


def sample(sensor, seed=0, ppp=2.0):
    rng = np.random.default_rng(seed)
    codes = rng.integers(0, sensor.levels, (5, 16, 24)).astype(np.uint8)
    target = torch.from_numpy(rng.random((5, 1, 16, 24), np.float32))
    found = mt.prepare(array_codes(codes, sensor, EXPOSURE), seed)
    white = sensor.white(EXPOSURE)
    return {"codes": torch.zeros(5, 1, 16, 24), "target": target, "white": white, "peak": 2.5 * ppp} | found


@pytest.mark.parametrize("sensor", [QIS(0.8, 1.6, 0.2, 3), QIS(0.8, 1.6, 0.2, 7), BinarySPAD(1.0, 0.0, 5)])
def test_the_table_is_the_inverse_of_phi(sensor):
    domain = information_domain(sensor, EXPOSURE)
    one = sample(sensor)
    light = np.linspace(0.02, 0.9, 50) * sensor.white(EXPOSURE)
    phi = np.interp(light, domain.photons, domain.phi)
    found = mt.light_of(torch.tensor(phi, dtype=torch.float32)[None, None], one["top"][None], one["table"][None])
    assert found.flatten().tolist() == pytest.approx((light / sensor.white(EXPOSURE)).tolist(), rel=1e-3, abs=2e-4)


def test_windows_of_different_sensors_share_a_batch():
    batch = default_collate([sample(QIS(0.8, 1.6, 0.2, 3)), sample(BinarySPAD(1.0, 0.0, 1))])
    light, place = mt.restored(MergeNet(), batch)
    assert light.shape == (2, 1, 1, 16, 24)
    assert place == 2


def test_the_loss_is_the_mean_of_the_logarithms_of_errors():
    batch = default_collate([sample(QIS(0.8, 1.6, 0.2, 3), seed) for seed in range(3)])
    light, place = mt.restored(MergeNet(), batch)
    unit = float(batch["white"][0] / batch["peak"][0])
    squares = []
    for i in range(3):
        pair = [x.numpy() * unit for x in (light[i, 0, 0].detach(), batch["target"][i, place, 0])]
        shown = [np.where(x > 1, 1 + mt.ABOVE * (x - 1), x) for x in pair]
        squares.append(math.log(((shown[0] - shown[1]) ** 2).mean() + mt.FLOOR))
    found = mt.loss(MergeNet(), batch, Settings("", "", steps=1), 0.0)
    assert found.item() == pytest.approx(np.mean(squares), rel=1e-5)


def test_training_lowers_the_loss():
    torch.manual_seed(0)
    network = MergeNet(MergeNetConfig(4))
    batch = default_collate([sample(QIS(0.8, 1.6, 0.2, 3), seed) for seed in range(2)])
    optimiser = torch.optim.Adam(network.parameters(), 3e-3)
    losses = []
    for _ in range(30):
        losses.append(mt.loss(network, batch, Settings("", "", steps=1), 0.0))
        optimiser.zero_grad()
        losses[-1].backward()
        optimiser.step()
    assert losses[-1].item() < losses[0].item() - 0.01


def test_inputs_of_a_batch_are_those_of_its_windows():
    """Over sensors, bits and missing frames. In the batch codes are over the top code, as samples have them."""
    rng = np.random.default_rng(2)
    sensors = [random_sensor(rng) for _ in range(20)]
    assert len({mt.kept_frames(n) for n in range(20)}) > 4
    codes = [window_of(rng, sensor, (11, 40, 48)) for sensor in sensors]
    windows = [array_codes(one, sensor, EXPOSURE) for one, sensor in zip(codes, sensors, strict=True)]
    alone = collated([mt.prepare(window, n) for n, window in enumerate(windows)])
    samples = [{"codes": as_input(one, sensor)} for one, sensor in zip(codes, sensors, strict=True)]
    known = [seen_by(window, n) for n, window in enumerate(windows)]
    batch = collated([one | seen for one, seen in zip(samples, known, strict=True)])
    together = replace(SYSTEMS[MergeNet], prepare=seen_by).with_inputs(batch)
    assert set(together) == {"codes", *alone}
    for name, values in alone.items():
        torch.testing.assert_close(together[name], values, rtol=1e-5, atol=1e-4 if name == "channels" else 1e-5)


def test_some_windows_lack_frames():
    """Numbers decide, so that a resumed training draws the same; the rest of the windows is whole."""
    kept = [mt.kept_frames(n) for n in range(4000)]
    whole = kept.count((5, 5)) / len(kept)
    assert whole == pytest.approx(1 - mt.ENDS * 35 / 36, abs=0.03)
    assert len(set(kept)) == 36
    sensor = QIS(0.8, 1.6, 0.2, 3)
    codes = np.random.default_rng(0).integers(0, 8, (11, 16, 24)).astype(np.uint8)
    short = next(n for n in range(100) if mt.kept_frames(n) == (0, 4))
    found = mt.prepare(array_codes(codes, sensor, EXPOSURE), short)
    same = codes.copy()
    same[:5] = 0  # what lies before the middle frame is not seen
    assert torch.equal(found["channels"], mt.prepare(array_codes(same, sensor, EXPOSURE), short)["channels"])


def test_inputs_are_made_on_a_gpu_alone(monkeypatch):
    system = SYSTEMS[MergeNet]
    here = system.on(torch.device("cpu"))
    assert (here.prepare, here.prepare_batch) == (mt.prepare, None)
    assert here.with_inputs({"codes": torch.zeros(1)}) == {"codes": torch.zeros(1)}
    monkeypatch.setattr(training_system, "is_gpu", lambda device: True)
    there = system.on(torch.device("cpu"))
    assert (there.prepare, there.prepare_batch) == (seen_by, mt.prepare_batch)
    other = SYSTEMS[UNet].on(torch.device("cpu"))
    assert (other.prepare, other.prepare_batch) == (None, None)


@pytest.mark.parametrize("device", ["cpu", "meta"])
def test_the_inputs_of_a_batch_wait_for_nothing(device):
    """From the second batch on, when the tables of its sensors are there."""
    sensors = [QIS(0.8, 1.6, 0.2, 3), BinarySPAD(1.0, 0.0, 1)]
    system = replace(SYSTEMS[MergeNet], prepare=seen_by)
    batch = {
        "codes": torch.zeros(2, 11, 1, 40, 48, device=device),
        SENSORS: [SeenBy(sensor, EXPOSURE, sensor.white(EXPOSURE), n) for n, sensor in enumerate(sensors)],
        TOP: torch.ones(2, device=device),
    }
    system.with_inputs(batch)
    with Operators() as operators:
        system.with_inputs(batch)
    assert not operators.waits


def test_a_run_whose_inputs_are_made_on_the_device_learns_the_same(tiny_dataset, tmp_path, monkeypatch):
    """The CPU takes the place of the GPU; weights after some steps are those of inputs that workers make."""
    weights = []
    for name, windows in (("workers", "host"), ("windows", "device"), ("device", "host")):
        torch.manual_seed(0)
        network = MergeNet(MergeNetConfig(4))
        settings = Settings(
            str(tiny_dataset), str(tmp_path / name), steps=3, crop=16, batch=2, loss="own", windows=windows
        )
        said = list[str]()
        train(network, settings, progress=False, note=said.append)
        assert any("drawn on the device" in line for line in said) == (name == "windows")
        weights.append(torch.cat([value.flatten() for value in network.state_dict().values()]))
        if name == "windows":
            monkeypatch.setattr(training_system, "is_gpu", lambda device: True)
    torch.testing.assert_close(weights[0], weights[1], rtol=0, atol=1e-5)
    assert torch.equal(weights[1], weights[2])


def test_the_loop_knows_the_system():
    system = system_of(build("mergenet"))
    assert system.name == "mergenet"
    assert system.prepare is mt.prepare
