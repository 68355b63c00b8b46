"""Runs `quiver completion`: prints the script that completes its lines in a shell."""

from __future__ import annotations

from qsim.cli.command import command
from qsim.cli.completion import Completion, printed


@command(
    "quiver completion bash >> ~/.bashrc",
    "quiver completion zsh >> ~/.zshrc",
    "quiver completion fish > ~/.config/fish/completions/quiver.fish",
)
def completion(asked: Completion) -> int:
    """Print the completion script of `quiver`."""
    return printed(asked)
