"""Training of MergeNet: inputs of a window, the table from phi to light, and a loss in decibels."""

import math

import numpy as np
import pytest
import torch
from torch.utils.data import default_collate

from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD
from quiver.baselines.information_domain import information_domain
from quiver.data.codes import array_codes
from quiver.model.mergenet import MergeNet, MergeNetConfig
from quiver.model.presets import build
from quiver.training import merge_training as mt
from quiver.training.settings import Settings
from quiver.training.systems import system_of

EXPOSURE = 5e-4


def sample(sensor, seed=0, ppp=2.0):
    rng = np.random.default_rng(seed)
    codes = rng.integers(0, sensor.levels, (5, 16, 24)).astype(np.uint8)
    target = torch.from_numpy(rng.random((5, 1, 16, 24), np.float32))
    found = mt.prepare(array_codes(codes, sensor, EXPOSURE))
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


def test_the_loop_knows_the_system():
    system = system_of(build("mergenet"))
    assert system.name == "mergenet"
    assert system.prepare is mt.prepare
