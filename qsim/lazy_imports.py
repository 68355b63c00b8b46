"""Lets a package import its public names when they are first used, as its stub lists them.

    __init__.pyi    from .camera import Camera as Camera        the one list: for type checkers, editors and this module
    __init__.py     __getattr__, __dir__, __all__ = lazy_imports.attach(__name__, __file__)

Modules and packages inside are attributes too, as after their import.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable
from importlib import import_module, util
from pathlib import Path
from typing import Any


def attach(package: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` of a package whose stub lies beside the file of its `__init__`."""
    homes = names_of(package, Path(file).with_suffix(".pyi"))

    def get(name: str) -> Any:
        if name in homes:
            module, original = homes[name]
            return getattr(import_module(module), original)
        if not name.startswith("_") and util.find_spec(f"{package}.{name}") is not None:
            return import_module(f"{package}.{name}")
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    def listing() -> list[str]:
        return sorted({*vars(sys.modules[package]), *homes})

    return get, listing, sorted(homes)


def names_of(package: str, stub: Path) -> dict[str, tuple[str, str]]:
    """Return the module of every name that a stub imports, and the name there."""
    homes = {}
    for node in ast.parse(stub.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom):
            module = f"{package}.{node.module}" if node.level else str(node.module)
            for alias in node.names:
                homes[alias.asname or alias.name] = (module, alias.name)
    return homes
