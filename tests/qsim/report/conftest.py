"""The clip of noise that previews show."""

import numpy as np
import pytest

from qsim.cli.program import main
from qsim.clip.clip import Clip
from qsim.clip.manifest import RELATIVE
from qsim.clip.writer import ClipWriter

SHAPE = (5, 8, 11)


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Clip:
    """Noise of odd size with a truth: everything moves 2 px to the right, depth grows downwards, one row has none."""
    path = tmp_path_factory.mktemp("preview") / "odd"
    meta = {"shape": list(SHAPE), "frame_rate": 2000.0, "exposure": 5e-4, "radiance_unit": RELATIVE, "camera": None}
    flow = np.zeros((2, *SHAPE[1:]), np.float32)
    flow[0] = 2.0
    depth = np.repeat(np.linspace(1, 4, SHAPE[1], dtype=np.float32)[:, None], SHAPE[2], axis=1)
    depth[-1] = np.inf
    with ClipWriter(path, meta) as writer:
        for t in range(SHAPE[0]):
            radiance = np.random.default_rng(t).random(SHAPE[1:])
            writer.add(t, radiance, truth={"flow": flow, "depth": depth}, error=0.01)
    assert main(["sense", str(path), "--ppp", "3.25", "--bits", "3", "-o", "mine"]) == 0
    return Clip.open(path)
