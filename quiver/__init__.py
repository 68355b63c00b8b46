"""Restores blur-free video from few-bit quanta streams; trains, evaluates and compares methods.

    video = quiver.restore(stream)
    quiver.score(video, stream).psnr
    data = quiver.windows("out/starter", split="train")
    loader = DataLoader(data, batch_sampler=Batches(8, first=0, last=1000))  # Batches: quiver.data.windows

Torch is imported with the first network or window, not with the package.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from qsim.lazy_imports import lazy_names

if TYPE_CHECKING:
    from quiver.data.windows import windows
    from quiver.evaluation.comparison import score_video as score
    from quiver.model.published_weights import from_published
    from quiver.model.quiver import QUIVER
    from quiver.restoration.api import restore

_HOMES = {
    "QUIVER": "model.quiver",
    "from_published": "model.published_weights",
    "restore": "restoration.api",
    "score": "evaluation.comparison:score_video",
    "windows": "data.windows",
}

__all__ = ["QUIVER", "from_published", "restore", "score", "windows"]

__getattr__ = lazy_names(__name__, _HOMES)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
