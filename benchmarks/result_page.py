"""Makes what all pages of results share: the title, the program that makes the page, and where its text goes."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from qsim.files import write_bytes


def head(title: str, command: str, more: str = "") -> list[str]:
    """Return the first lines of a page; `command` is the program with its arguments, `more` continues the sentence."""
    return [f"# {title}", "", f"Made by `python benchmarks/{command}`{more}.", ""]


def main(text: str | None, page: Callable[..., str], **arguments: str) -> None:
    """Print a page, or write it with --page FILE. `arguments` are folders that `page` takes, each with its help."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--page", type=Path, help="file to write")
    for name, what in arguments.items():
        parser.add_argument(f"--{name}", type=Path, help=what)
    asked = vars(parser.parse_args())
    file = asked.pop("page")
    content = page(**asked)
    if file is None:
        print(content)
    else:
        write_bytes(file, content.encode())
