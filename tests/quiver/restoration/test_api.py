"""`quiver.restore` in Python: the same default method as the command, and refusals of what it would ignore."""

from __future__ import annotations

import numpy as np
import pytest

import quiver
from quiver.cli.program import main


@pytest.mark.filterwarnings("ignore:mergenet ")  # measured or not for such streams
def test_the_command_and_the_call_have_one_default_method(inputs, tmp_path):
    assert main(["restore", str(inputs["clip"]), "-o", str(tmp_path / "r.npy"), "-q"]) == 0
    np.testing.assert_allclose(quiver.restore(inputs["clip"]), np.load(tmp_path / "r.npy"), atol=1e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mode": "streaming"}, "--mode: acts on networks, and moment is classical"),
        ({"device": "cpu"}, "--device: acts on networks"),
    ],
)
def test_the_call_refuses_what_it_would_ignore(inputs, changes, message):
    with pytest.raises(ValueError, match=message):
        quiver.restore(inputs["clip"], "moment", **changes)
    with pytest.raises(ValueError, match="a stream has its own light"):
        quiver.restore(inputs["stream"], "moment", ppp=3.0)
