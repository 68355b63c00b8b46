"""Tiny clips and data sets in the folders of a test."""

from __future__ import annotations

from pathlib import Path

import pytest
from clips import ClipMaker, write_clip, write_dataset

from qsim.clip import Clip


@pytest.fixture(scope="session")
def tiny_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three clips to train on, two to validate, two to test."""
    return write_dataset(tmp_path_factory.mktemp("data") / "tiny", {"train": 3, "val": 2, "test": 2})


@pytest.fixture
def make_clip(tmp_path: Path) -> ClipMaker:
    """make_clip("name", frames=..., height=..., seed=...) -> Clip in a folder of this test."""

    def make(name: str = "sliding_0", **options: object) -> Clip:
        return write_clip(tmp_path / "clips" / name, **options)

    return make
