"""Writes the parts of pages that come from the code, so that they can be read without building anything.

make reference      (python docs/manual/generated.py) fills them; a test compares them with the code

<!-- generated: keys [recipe] -->     the keys of a section of a recipe or of a sensor file
<!-- generated: commands qsim -->     all commands of a program
<!-- generated: names quiver -->      the public names of a package
...
<!-- end -->
"""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

DOCS = Path(__file__).parents[1]
if __name__ == "__main__":
    sys.path[:0] = [str(DOCS.parent), str(DOCS)]

from manual import commands, keys  # noqa: E402
from qsim.cli import documented_keys  # noqa: E402

_PART = re.compile(r"^<!-- generated: (\w+) (\S+) -->\n.*?^<!-- end -->$", re.MULTILINE | re.DOTALL)


def names(package: str) -> str:
    """Return a Markdown table of the public names of a package: how each is called, and its first sentence."""
    module = import_module(package)
    rows = ["| name | what it is |", "|---|---|"]
    for name in sorted(module.__all__, key=str.lower):
        thing = getattr(module, name)
        if inspect.ismodule(thing) or not (inspect.isclass(thing) or inspect.isfunction(thing)):
            continue
        called = f"{package}.{name}" + _parameters(thing)
        about = (inspect.getdoc(thing) or "").partition("\n")[0].replace("|", "\\|")
        rows.append(f"| `{called}` | {about} |")
    return "\n".join(rows)


def _parameters(thing: Callable[..., object]) -> str:
    """Return the parameters of a function, without types; those of a class are its fields, in the built manual."""
    if inspect.isclass(thing):
        return ""
    found = inspect.signature(thing).parameters.values()
    return "(" + ", ".join(f"{'*' * (one.kind - 1) if one.kind in (2, 4) else ''}{one.name}" for one in found) + ")"


WRITERS: dict[str, Callable[[str], str]] = {
    "keys": lambda section: keys.table(documented_keys.keys(section)),
    "commands": lambda program: commands.reference(import_module(f"{program}.cli.program").PROGRAM),
    "names": names,
}


def filled(text: str) -> str:
    """Return a page whose generated parts are those of the code now."""
    return _PART.sub(_part, text)


def _part(found: re.Match[str]) -> str:
    kind, what = found.groups()
    return f"<!-- generated: {kind} {what} -->\n\n{WRITERS[kind](what).strip()}\n\n<!-- end -->"


def pages() -> list[Path]:
    """Return the pages with generated parts."""
    return [path for path in sorted(DOCS.rglob("*.md")) if _PART.search(path.read_text(encoding="utf-8"))]


if __name__ == "__main__":
    for path in pages():
        path.write_text(filled(path.read_text(encoding="utf-8")), encoding="utf-8")
        print(path.relative_to(DOCS.parent))
