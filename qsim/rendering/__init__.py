"""Renders scenes to radiance of a stated error, with ground truth. Only this room renders with Mitsuba."""

from typing import TYPE_CHECKING

from qsim.lazy_imports import lazy_names

if TYPE_CHECKING:
    from qsim.rendering.budget import Budget
    from qsim.rendering.clip_rendering import render_clip
    from qsim.rendering.fidelity import choose_budget
    from qsim.rendering.mitsuba_xml import read_mitsuba
    from qsim.rendering.renderer import Renderer

__all__ = ["Budget", "Renderer", "choose_budget", "read_mitsuba", "render_clip"]

__getattr__ = lazy_names(
    __name__,
    {
        "Budget": "budget",
        "Renderer": "renderer",
        "choose_budget": "fidelity",
        "read_mitsuba": "mitsuba_xml",
        "render_clip": "clip_rendering",
    },
)
