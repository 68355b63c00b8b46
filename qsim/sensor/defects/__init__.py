"""Models deviations from an ideal pixel: fixed-pattern and correlated noise; simulates photons one by one."""

from typing import TYPE_CHECKING

from qsim.lazy_imports import lazy_names

if TYPE_CHECKING:
    from qsim.sensor.defects.defect_table import Defects
    from qsim.sensor.defects.fixed_pattern import FixedPattern, Maps, draw_maps
    from qsim.sensor.defects.pixel_array import PixelArray

__all__ = ["Defects", "FixedPattern", "Maps", "PixelArray", "draw_maps"]

__getattr__ = lazy_names(
    __name__,
    {
        "Defects": "defect_table",
        "FixedPattern": "fixed_pattern",
        "Maps": "fixed_pattern",
        "PixelArray": "pixel_array",
        "draw_maps": "fixed_pattern",
    },
)
