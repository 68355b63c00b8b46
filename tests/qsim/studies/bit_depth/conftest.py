"""Shares the clip of waves among the tests of bit-depth studies."""

import pytest
from waves import wave_clip


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return wave_clip(tmp_path_factory.mktemp("tradeoff") / "wave", 64, 1)
