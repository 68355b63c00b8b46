from .budget import Budget as Budget
from .clip_rendering import render_clip as render_clip
from .fidelity import choose_budget as choose_budget
from .mitsuba_xml import read_mitsuba as read_mitsuba
from .renderer import Renderer as Renderer
