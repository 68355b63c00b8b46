"""Lets packages import their public names and modules when they are first used."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module, util
from typing import Any


def lazy_names(package: str, homes: dict[str, str]) -> Callable[[str], Any]:
    """Return the `__getattr__` of a package that imports public names and modules when they are first used.

    `homes` maps names to modules; "module:other" if the name is `other` there.
    """

    def get(name: str) -> Any:
        if name not in homes:
            if not name.startswith("_") and util.find_spec(f"{package}.{name}") is not None:
                return import_module(f"{package}.{name}")
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, _, other = homes[name].partition(":")
        return getattr(import_module(f"{package}.{module}"), other or name)

    return get
