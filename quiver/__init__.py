"""Restores blur-free video from few-bit quanta streams; trains, evaluates and compares methods.

In Python: `quiver.restore(codes, "moment", ...)`, and the networks `QUIVER` and `from_published`. Torch is
imported with the first of these names, not with the package.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from qsim.files import lazy_names

if TYPE_CHECKING:
    from quiver.model.published_weights import from_published
    from quiver.model.quiver import QUIVER
    from quiver.restoration.api import restore

_HOMES = {
    "QUIVER": "model.quiver",
    "from_published": "model.published_weights",
    "restore": "restoration.api",
}

__all__ = ["QUIVER", "from_published", "restore"]

__getattr__ = lazy_names(__name__, _HOMES)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
