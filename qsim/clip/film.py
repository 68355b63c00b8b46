"""Shows frames in notebooks: pictures and films as HTML that loads nothing."""

from __future__ import annotations

import base64
import html
import io
from dataclasses import dataclass

from numpy import ndarray as Array

from qsim import colour
from qsim.lazy_array import LazyArray

MOST_FRAMES = 100  # of a film, unless more are requested
NARROWEST = 256  # px, at which pictures are shown


@dataclass(frozen=True, eq=False)
class Film:
    """Frames as pictures, uint8 [T, H, W] or [T, H, W, 3].

    A notebook shows them as an animation if this is the last line of a cell.
    """

    pictures: Array
    caption: str
    fps: float  # frames per second, as shown

    @classmethod
    def of(cls, name: str, frames: LazyArray, start: int, stop: int | None, fps: float) -> Film:
        """Return frames start ... stop - 1 of [T, H, W] or [T, 3, H, W] with the tone curve of every picture.

        White is their own peak.
        `ValueError` for frames that do not exist, and for a speed outside of 0 to 50 frames per second.
        """
        last = min(len(frames), start + MOST_FRAMES) if stop is None else stop
        if not 0 <= start < last <= len(frames):
            raise ValueError(f"{name}: frames {start}..{last - 1} do not all exist; there are 0..{len(frames) - 1}")
        if not 0 < fps <= 50:
            raise ValueError(f"{name}: a film shows above 0 and at most 50 frames per second, got {fps!r}")
        values = frames[start:last]
        brightest = colour.peak(values)
        caption = f"{name}, frames {start}..{last - 1} of {len(frames)}, brightest shown = {brightest:.4g}"
        return cls(colour.tone_picture(values, brightest, colours=values.ndim == 4), caption, fps)

    def __repr__(self) -> str:
        return f"<Film of {self.caption}; shown by notebooks, `qsim preview` writes files>"

    def _repr_html_(self) -> str:
        return figure(self.pictures, self.caption, self.fps)


def card(text: str, picture: Array) -> str:
    """Return a picture, uint8 [H, W] or [H, W, 3], with a text below as HTML."""
    return figure(picture[None], text.strip("<>"))


def figure(pictures: Array, caption: str, fps: float = 12.0) -> str:
    """Return pictures, uint8 [T, H, W] or [T, H, W, 3], as an HTML figure: a PNG, of several grey ones a GIF."""
    from PIL import Image

    images = [Image.fromarray(picture) for picture in pictures]
    # a GIF has 256 colours
    kind = "gif" if len(images) > 1 and pictures.ndim == 3 else "png"
    buffer = io.BytesIO()
    animated = {"save_all": True, "append_images": images[1:], "duration": round(1000 / fps), "loop": 0}
    images[0].save(buffer, kind, **(animated if len(images) > 1 else {}))
    source = f"data:image/{kind};base64,{base64.b64encode(buffer.getvalue()).decode()}"
    text = html.escape(caption)
    width = max(NARROWEST, pictures.shape[2])
    style = f"width:{width}px;max-width:100%;image-rendering:pixelated"
    return (
        f'<figure style="margin:0"><img src="{source}" alt="{text}" style="{style}">'
        f"<figcaption>{text}</figcaption></figure>"
    )
