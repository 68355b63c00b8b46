"""Tiny clips and data sets in the folders of a test; torch draws the same in every order of tests."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from clips import ClipMaker, write_clip, write_dataset

from qsim.streams.clip import Clip


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """Before the test's fixtures: weights that it draws do not depend on which tests its process ran before."""
    torch.manual_seed(0)


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
