"""Tests the light and the noise of codes over several clip frames."""

from __future__ import annotations

import pytest

from quiver.data.illumination import Illumination, file_digests


@pytest.mark.parametrize("stated", ["", "bits = 1\n"], ids=["no bits", "bits of a plane"])
def test_a_sensor_file_serves_sums_of_any_number_of_planes(tmp_path, stated):
    file = tmp_path / "spad.toml"
    file.write_text(f'[sensor]\nmodel = "BinarySPAD"\npde = 0.5\ndark_count_rate = 100.0\n{stated}')
    for planes, bits in ((1, 1), (7, 3), (10, 4)):
        made = Illumination.of(str(file), 4.9, None).over(planes)
        assert made.device(5e-4).bits == bits
        assert file_digests([made]).keys() <= {str(file)}
        assert made.device(5e-4).levels == planes + 1
