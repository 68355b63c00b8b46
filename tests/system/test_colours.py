"""Tests the colours of the library: every family, its geometry unchanged, reflectances that exist."""

import numpy as np
import pytest

from qsim import scenes
from qsim.optics.radiometry import RGB
from qsim.scene import Glow, Texture
from qsim.scenes.colours import coloured

QUICK = ("fan", "room", "tumble")


@pytest.mark.parametrize(
    "family", [pytest.param(f, marks=() if f in QUICK else pytest.mark.slow) for f in sorted(scenes.FAMILIES)]
)
def test_every_family_has_colours(family):
    grey = scenes.load(family, 3)
    found = coloured(grey)
    again = coloured(scenes.load(family, 3))
    assert found.bands == RGB
    assert found.camera is grey.camera
    differing = 0
    for one, other, same in zip(grey.bodies, found.bodies, again.bodies, strict=True):
        assert other.mesh is one.mesh
        assert other.motion is one.motion
        before, after = (getattr(body.material, "reflectance", None) for body in (one, other))
        if isinstance(after, Texture):
            colours = after.colours()
            differing += bool((colours.max(axis=2) - colours.min(axis=2)).max() > 0.05)
            assert colours.min() >= 0
            assert colours.max() <= max(0.95, before.pixels().max())
            np.testing.assert_array_equal(colours, same.material.reflectance.colours())
        elif isinstance(after, tuple):
            differing += max(after) - min(after) > 0.02
            assert np.mean(after) <= before + 1e-9
        elif isinstance(other.material, Glow):
            assert np.mean(other.material.radiance) == pytest.approx(one.material.radiance)
    lamps = [light for light in found.lights if any(isinstance(v, tuple) and len(v) == 3 for v in vars(light).values())]
    assert differing or lamps
    with pytest.raises(ValueError, match="states its bands already"):
        coloured(found)
