"""Tests flow over several frames against motions that are known in closed form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy import ndarray as Array

from qsim.clip.composed_flow import composed

SHAPE = (40, 50)


@dataclass
class Spinning:
    """A disk that turns about the middle of the picture, before a background at rest; `square` hides a part of it."""

    angle: float  # rad per frame
    radius: float = 15.0  # px
    square: bool = False

    def grid(self) -> tuple[Array, Array]:
        places = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
        y = places[0]
        x = places[1]
        return y - 19.5, x - 24.5

    def body_id(self, t: int) -> Array:
        y, x = self.grid()
        found = np.where(np.hypot(y, x) < self.radius, 1, 0)
        if self.square:
            found[:, :20] = 2
        return found.astype(np.int32)

    def flow(self, t: int) -> Array:
        y, x = self.grid()
        moved = self.turned(self.angle)
        return np.where(self.body_id(t) == 1, moved, 0.0 * np.stack([x, y])).astype(np.float32)

    def turned(self, angle: float) -> Array:
        """The flow of the disk when it turns by an angle."""
        y, x = self.grid()
        return np.stack([np.cos(angle) * x - np.sin(angle) * y - x, np.sin(angle) * x + np.cos(angle) * y - y])

    def valid(self, t: int) -> Array:
        u, _v = self.flow(t)
        x = np.mgrid[: SHAPE[0], : SHAPE[1]][1]
        hidden = self.square & (np.rint(x + u) < 20) & (self.body_id(t) == 1)
        return ~hidden

    def depth(self, t: int) -> Array:
        return np.where(self.body_id(t) == 0, np.inf, 3.0).astype(np.float32)

    def holds(self, channel: str) -> bool:
        return True


@pytest.mark.parametrize("frames", [2, 7])
def test_a_turning_disk_turns_by_all_angles_together(frames: int):
    """Flow is linear in place, so that it is exact between pixels; the rim is continued from within."""
    disk = Spinning(0.03)
    flow, valid = composed(disk, 0, frames)
    inside = disk.body_id(0) == 1
    expected = np.where(inside, disk.turned(0.03 * frames), 0.0)
    y, x = disk.grid()
    deep = np.hypot(y, x) < disk.radius - 1.5
    assert valid[deep].all()
    np.testing.assert_allclose(flow[:, deep], expected[:, deep], atol=1e-5)
    np.testing.assert_allclose(flow[:, valid], expected[:, valid], atol=0.03 * np.sqrt(2) * frames)
    assert (~valid).mean() < 0.03


def test_one_frame_is_that_of_the_clip():
    disk = Spinning(0.03)
    flow, valid = composed(disk, 4, 5)
    np.testing.assert_array_equal(flow, disk.flow(4))
    np.testing.assert_array_equal(valid, disk.valid(4))


def test_points_that_are_hidden_on_the_way_are_not_valid():
    """The disk turns behind a square: what goes there is lost, and moves on."""
    disk = Spinning(0.05, square=True)
    flow, valid = composed(disk, 0, 8)
    end = disk.grid()[1] + 24.5 + disk.turned(0.4)[0]
    goes = (disk.body_id(0) == 1) & (end < 18)
    stays = (disk.body_id(0) == 1) & (end > 22) & (np.hypot(*disk.grid()) < 13) & (disk.grid()[1] + 24.5 > 22)
    assert goes.sum() > 20
    assert not valid[goes].any()
    assert valid[stays].all()
    assert np.isfinite(flow).all()
