"""Environment maps: radiance in the stated scale, artefacts below 0 removed, anything else refused."""

import numpy as np
import pytest

from qsim.scene import EnvironmentImage
from qsim.scene.environment import environment_map


def test_slightly_negative_radiance_becomes_zero_and_more_is_refused():
    """Free maps hold -0.03 of their mean; a picture that reaches -0.1 is no radiance."""
    picture = np.random.default_rng(0).uniform(0.5, 1.5, (8, 16)).astype(np.float32)
    picture[3, 4] = -0.03
    found = environment_map(EnvironmentImage(picture, scale=2.0))
    assert found[3, 4] == 0
    np.testing.assert_allclose(np.delete(found, 52), 2 * np.delete(picture, 52))
    picture[3, 4] = -0.1
    with pytest.raises(ValueError, match=r"at least 0, found -0\.1"):
        environment_map(EnvironmentImage(picture))
