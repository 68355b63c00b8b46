"""`quiver.restore` in Python: the same default method as the command, and refusals of what it would ignore."""

from __future__ import annotations

import numpy as np
import pytest

import quiver
from qsim.sensor import devices
from quiver.cli.program import main


@pytest.mark.filterwarnings("ignore:mergenet ")  # measured or not for such streams
def test_the_command_and_the_call_have_one_default_method(inputs, tmp_path):
    assert main(["restore", str(inputs["clip"]), "-o", str(tmp_path / "r.npy"), "-q"]) == 0
    np.testing.assert_allclose(quiver.restore(inputs["clip"]), np.load(tmp_path / "r.npy"), atol=1e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mode": "streaming"}, "mode: acts on networks, and moment is classical"),
        ({"device": "cuda"}, "device=cuda: torch finds no CUDA device here"),
    ],
)
def test_the_call_refuses_what_it_would_ignore(inputs, changes, message):
    with pytest.raises(ValueError, match=message):
        quiver.restore(inputs["clip"], "moment", **changes)
    with pytest.raises(ValueError, match="a stream has its own light"):
        quiver.restore(inputs["stream"], "moment", ppp=3.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"exposure": 0}, "exposure= is in seconds and above 0, got 0"),
        ({"exposure": float("nan")}, "exposure= is in seconds"),
        ({"sensor": "quiver-physical"}, "sensor= is a sensor, as qsim.load_sensor"),
        ({"method": None}, "method= is a name"),
        ({"method": "mergenet", "device": "gpu"}, "device: expected one of auto, cpu, cuda, got 'gpu'"),
        ({"defects": np.where(np.eye(8) > 0, 0.3, 0.0)}, "defects=: a map of defective pixels is"),
        ({"defects": np.full((8, 8), np.nan)}, "defects=: a map of defective pixels is"),
        ({"defects": np.full((8, 8), 255, np.uint8)}, "defects=: a map of defective pixels is"),
        ({"defects": "map.npy"}, "defects=: a map of defective pixels is"),
    ],
)
def test_mistakes_of_the_call_are_one_sentence(changes, message):
    sensor = devices.load("quiver-physical", ppp=3.25, bits=3, exposure=5e-4)
    known = {"method": "moment", "sensor": sensor, "exposure": 5e-4} | changes
    with pytest.raises(ValueError, match=message):
        quiver.restore(np.ones((3, 8, 8), np.uint8), **known)


def test_a_path_of_a_bare_array_says_what_to_give(tmp_path):
    np.save(tmp_path / "a.npy", np.ones((3, 8, 8), np.uint8))
    with pytest.raises(ValueError, match="a bare array; give numpy"):
        quiver.restore(tmp_path / "a.npy")
