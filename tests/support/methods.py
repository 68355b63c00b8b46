"""Restorers made of one function, and one that always fails."""

from __future__ import annotations

from numpy import ndarray as Array

from quiver.data.codes import Codes
from quiver.restoration.interface import Restorer


def method(name: str, restore: object, learned: bool = False) -> Restorer:
    """A restorer from a function of (codes) -> photons [T, H, W]."""

    def fill(codes: Codes, out: Array, first: int, progress: object) -> None:
        out += restore(codes)[first : first + len(out)]

    return Restorer(name, 1, 0, learned, f"test {name}", fill)


def broken(codes: Codes) -> Array:
    """Fail with a message of two lines."""
    raise RuntimeError("no road\nleads there")
