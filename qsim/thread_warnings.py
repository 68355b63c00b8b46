"""Treats the warnings of one thread in another way, while other threads keep theirs.

`warnings.catch_warnings` swaps one list for the whole process: a decoder's strictness in one thread made errors of the
warnings in another, and two threads that leave it in the order in which they came leave it changed for good.
"""

from __future__ import annotations

import contextlib
import threading
import warnings
from collections.abc import Iterator
from typing import Literal

Action = Literal["error", "ignore"]

_lock = threading.Lock()
_here = threading.local()  # .actions: those of the blocks that this thread is in, the innermost last


class _InSuchABlock(type):
    """Counts every warning as its subclass in a thread whose innermost block has the action."""

    action: Action

    def __subclasscheck__(cls, other: type) -> bool:
        actions: list[Action] = getattr(_here, "actions", [])
        return bool(actions) and actions[-1] == cls.action


class _Refused(Warning, metaclass=_InSuchABlock):
    action: Action = "error"


class _Ignored(Warning, metaclass=_InSuchABlock):
    action: Action = "ignore"


@contextlib.contextmanager
def warnings_here(action: Action) -> Iterator[None]:
    """Raise or ignore every warning that this thread gives in the block."""
    with _lock:
        for kind in (_Refused, _Ignored):
            if not any(kind in known for known in warnings.filters[:2]):  # the first that matches acts
                warnings.simplefilter(kind.action, kind)
    actions = _here.__dict__.setdefault("actions", [])
    actions.append(action)
    try:
        yield
    finally:
        actions.pop()
