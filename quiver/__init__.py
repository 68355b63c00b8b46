"""quiver: restores blur-free video from few-bit quanta streams; trains, evaluates and compares.

`quiver.restore(codes, "moment", ...)` is the whole of it in a notebook; nothing heavy is imported before it is called.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from quiver.restoration.api import restore

__all__ = ["restore"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'quiver' has no attribute {name!r}")
    from quiver.restoration import api

    return getattr(api, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
