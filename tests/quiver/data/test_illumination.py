"""Tests the light and the noise of codes over several clip frames."""

from __future__ import annotations

from quiver.data.illumination import Illumination


def test_a_file_without_bits_serves_sums_of_any_number_of_planes(tmp_path):
    file = tmp_path / "spad.toml"
    file.write_text('[sensor]\nmodel = "BinarySPAD"\npde = 0.5\ndark_count_rate = 100.0\n')
    for planes, bits in ((1, 1), (7, 3), (10, 4)):
        made = Illumination.of(str(file), 4.9, None).over(planes)
        assert made.bits == bits
        assert made.device(5e-4).levels == planes + 1
