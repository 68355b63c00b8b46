"""The clip of waves that the studies of bit depth are made of."""

import pytest
from waves import wave_clip


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return wave_clip(tmp_path_factory.mktemp("tradeoff") / "wave", 64, 1)
