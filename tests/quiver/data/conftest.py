"""A data set whose streams were drawn by a sensor with defects."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from clips import write_dataset

from qsim.streams.sensing import Sensing
from qsim.streams.storing import sense
from quiver.data.clips import open_clips


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """Two clips to train on, one to validate, with streams of a SPAD at two light levels and a dark-count map."""
    path = write_dataset(tmp_path / "data", {"train": 2, "val": 1})
    np.save(tmp_path / "dark.npy", np.random.default_rng(0).lognormal(4, 1, (40, 50)))
    (tmp_path / "map.toml").write_text('[defects]\ndark_map = "dark.npy"\n')
    for clip in open_clips(path):
        for ppp in (10.0, 1.0):
            sense(clip, Sensing("spad-320x240", bits=1, ppp=ppp, defects=str(tmp_path / "map.toml")))
    return path
