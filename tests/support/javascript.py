"""Runs the scripts of our pages in a JavaScript engine (V8), without a browser."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from py_mini_racer import MiniRacer

TEMPLATES = Path(__file__).parents[2] / "qsim" / "report" / "templates"


class Script:
    """The functions of one script of the templates."""

    def __init__(self, engine: MiniRacer) -> None:
        self.engine = engine

    def value(self, expression: str, **names: Any) -> Any:
        """The value of an expression as JSON holds it; `names` are constants in it."""
        constants = "".join(f"const {name} = {json.dumps(value)};" for name, value in names.items())
        return json.loads(self.engine.eval(f"JSON.stringify((() => {{ {constants} return {expression}; }})())"))


@contextmanager
def script(name: str) -> Iterator[Script]:
    """The engine with a script loaded; closed afterwards, as its threads would keep the process alive."""
    with MiniRacer() as engine:
        engine.eval((TEMPLATES / name).read_text(encoding="utf-8"))
        yield Script(engine)
