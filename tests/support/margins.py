"""A plugin of pytest that writes which share of its tolerance every comparison of floats takes.

`python tests/processors.py --margins FOLDER` loads it. Each line of the file that FLOAT_MARGINS names is a list: the
test, the number of the comparison in it, its place, and the largest difference in units of what is allowed.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import wraps
from typing import Any

import numpy as np
import pytest

_OUT = os.environ["FLOAT_MARGINS"]
_HERE: dict[str, Any] = {"test": "", "number": 0}


def _place() -> str:
    """File and line of the test, or of its helper, that compares."""
    frame = sys._getframe(2)
    while frame.f_back is not None and f"{os.sep}tests{os.sep}" not in frame.f_code.co_filename.replace(__file__, ""):
        frame = frame.f_back
    return f"{os.path.relpath(frame.f_code.co_filename)}:{frame.f_lineno}"


def note(share: float) -> None:
    """Writes one comparison."""
    _HERE["number"] += 1
    with open(_OUT, "a") as file:
        file.write(json.dumps([_HERE["test"], _HERE["number"], _place(), float(share)]) + "\n")


def share_of(found: Any, wanted: Any, rtol: float, atol: float) -> float:
    """The largest difference of finite numbers over what is allowed; equal numbers need nothing."""
    found, wanted = np.broadcast_arrays(np.asarray(found, float), np.asarray(wanted, float))
    finite = np.isfinite(found) & np.isfinite(wanted) & (found != wanted)
    with np.errstate(divide="ignore"):
        shares = np.abs(found - wanted)[finite] / (atol + rtol * np.abs(wanted[finite]))
    return float(shares.max(initial=0.0))


def _noting(compare: Callable[..., Any], rtol: float, atol: float) -> Callable[..., Any]:
    """`compare(found, wanted, rtol, atol, ...)`, which also writes the share."""

    @wraps(compare)
    def noting(found: Any, wanted: Any, rtol: float = rtol, atol: float = atol, **more: Any) -> Any:
        given = [value.detach().double().numpy() if hasattr(value, "detach") else value for value in (found, wanted)]
        with suppress(TypeError, ValueError):  # the comparison itself says what is wrong
            note(share_of(*given, rtol, atol))
        return compare(found, wanted, rtol=rtol, atol=atol, **more)

    return noting


def _note_approx() -> None:
    """`pytest.approx` of one number, which those of sequences and arrays use for each of theirs."""
    scalar = type(pytest.approx(1.0))
    equal = scalar.__eq__

    def noting(self: Any, actual: Any) -> bool:
        if isinstance(actual, float | int) and isinstance(self.expected, float | int) and self.tolerance:
            note(share_of(actual, self.expected, 0.0, self.tolerance))
        return equal(self, actual)

    scalar.__eq__ = noting  # type: ignore[method-assign]


def pytest_collection_finish(session: pytest.Session) -> None:
    """After the tests are imported, and torch with them."""
    np.testing.assert_allclose = _noting(np.testing.assert_allclose, 1e-7, 0.0)
    np.allclose = _noting(np.allclose, 1e-5, 1e-8)
    if "torch" in sys.modules:
        torch: Any = sys.modules["torch"]
        torch.allclose = _noting(torch.allclose, 1e-5, 1e-8)
    _note_approx()


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Names the test that runs."""
    _HERE.update(test=item.nodeid, number=0)
    yield
