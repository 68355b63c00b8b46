"""Refuses `nano`, a network that earlier versions had: names the last commit that reads its weights and runs."""

from pathlib import Path

from qsim.files import read_json

NAME = "nano"
LAST_COMMIT = "8dbe2b5945"  # of the repository: its child removed the network
INSTEAD = f"the last commit that reads it is {LAST_COMMIT}; use mergenet"


class RemovedError(ValueError):
    """A name, a weights file or a run of a network that was removed."""


def refuse_name(name: str) -> None:
    """Raise `RemovedError` for the name of a removed network."""
    if name == NAME:
        raise RemovedError(f"the network {NAME} was removed; {INSTEAD}")


def refuse_run(folder: Path, *, replaced: bool = False) -> None:
    """Raise `RemovedError` if a folder holds a run of a removed network, or of its ablation, that is not replaced."""
    path = folder / "settings.json"
    if not replaced and path.is_file() and str(read_json(path).get("network")).split(" ")[0] == NAME:
        raise RemovedError(f"{folder}: a training run of {NAME}, a network that was removed; {INSTEAD}")
