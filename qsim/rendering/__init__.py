"""From a scene to radiance of a stated error, with ground truth. Only this room knows Mitsuba."""

from typing import TYPE_CHECKING

from qsim.files import lazy_names

if TYPE_CHECKING:
    from qsim.rendering.fidelity import Budget
    from qsim.rendering.mitsuba_xml import read_mitsuba
    from qsim.rendering.renderer import Renderer, render_clip

__all__ = ["Budget", "Renderer", "read_mitsuba", "render_clip"]

__getattr__ = lazy_names(
    __name__,
    {
        "Budget": "fidelity",
        "Renderer": "renderer",
        "read_mitsuba": "mitsuba_xml",
        "render_clip": "renderer",
    },
)
