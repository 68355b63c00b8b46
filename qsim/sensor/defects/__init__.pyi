from .defect_table import Defects as Defects
from .fixed_pattern import FixedPattern as FixedPattern
from .fixed_pattern import Maps as Maps
from .fixed_pattern import draw_maps as draw_maps
from .pixel_array import PixelArray as PixelArray
