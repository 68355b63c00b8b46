"""Shares a data set that was generated without interruption."""

import pytest
from fakes import HERE, SMALL, make, tree

from qsim.dataset.generation import Summary, generate


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files of the small data set, by name."""
    folder = tmp_path_factory.mktemp("undisturbed") / "small"
    assert generate(SMALL, folder, HERE, make=make) == Summary(3, 3, 3, {}, ())
    return tree(folder)
