"""A small data set with everything that is published, and its published forms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from clips import write_dataset
from published import KINDS, SENSINGS

from qsim.dataset.dataset import Dataset
from qsim.publishing import Publication, publish
from qsim.streams.storing import sense


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of three clips with two streams each, in a folder with a name that is not plain."""
    rng = np.random.default_rng(0)
    folder = tmp_path_factory.mktemp("a set") / "größe µ"
    flow = rng.normal(size=(2, 36, 44)).astype(np.float32)
    write_dataset(folder, {"train": 2, "val": 1}, sharp=True, flow=flow)
    for clip in Dataset.open(folder).clips():
        for sensing in SENSINGS:
            sense(clip, sensing)
    return folder


@pytest.fixture(scope="session")
def published(data: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The set in every format, in shards of one clip."""
    folder = tmp_path_factory.mktemp("published")
    for kind in KINDS:
        publish(data, folder / kind, Publication(to=kind, shard_size=0.4, licence="CC-BY-4.0"))
    return {kind: folder / kind for kind in KINDS}
