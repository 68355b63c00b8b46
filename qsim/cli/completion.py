"""Runs `qsim completion` and `quiver completion`: prints the script of cyclopts that completes lines in a shell.

Names of scenes, recipes, sensors and methods are asked of the program when they are completed.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Literal

from qsim.cli.command import command
from qsim.cli.console import output, running
from qsim.settings import setting


@dataclass(frozen=True)
class Completion:
    """The shell whose script is printed."""

    shell: Annotated[Literal["bash", "zsh", "fish"], setting("the shell", positional=True)]


def printed(asked: Completion) -> int:
    """Print the completion script of the running program."""
    program = running().program
    assert program is not None  # a command runs
    text = program.app.generate_completion(prog_name=program.name, shell=asked.shell)
    output({"shell": asked.shell, "script": text}, text)
    return 0


@command(
    "qsim completion bash >> ~/.bashrc",
    "qsim completion zsh >> ~/.zshrc",
    "qsim completion fish > ~/.config/fish/completions/qsim.fish",
)
def completion(asked: Completion) -> int:
    """Print the completion script of `qsim`."""
    return printed(asked)


def families() -> Iterable[str]:
    """Return the scene families."""
    from qsim.scenes import FAMILIES

    return FAMILIES


def recipes() -> Iterable[str]:
    """Return the names of the shipped recipes."""
    from qsim.scenes import RECIPES

    return RECIPES


def sensors() -> Iterable[str]:
    """Return the named sensors."""
    from qsim.sensor.devices import DEVICES

    return DEVICES
