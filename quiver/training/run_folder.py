"""Stores a training run in a folder: its settings, state, weights and curve.

    settings.json  checkpoint.pt  best.safetensors  last.safetensors  history.json  curve.png
    failed.pt (only after NaN)  events.out.tfevents...  lock

Every file is complete or absent, and one process at a time trains in a folder. A folder accepts only the settings that
it was made with, so that the same command resumes the run, and two runs are never mixed.
"""

from __future__ import annotations

import contextlib
import io
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import torch
from torch import nn

from qsim.figures import new_figure, write_figure
from qsim.files import Blocked, Damaged, check_ours, read_json, sync_folder, write_bytes, write_json
from qsim.locks import Lock
from quiver.device import random_states, set_random_states
from quiver.evaluation.json_values import json_safe
from quiver.model import weights
from quiver.training.optimiser import Optimiser
from quiver.training.schedule import State
from quiver.training.settings import Settings, portable, short

OURS = (  # files that a run writes
    r"(settings|history|schedule)\.json|(checkpoint|failed(-\d+)?)\.pt|(best|last)\.safetensors|curve\.png|lock|"
    r"events\.out\.tfevents\..*"
)
SCHEDULE = "schedule.json"  # of a run whose clips are rendered meanwhile
LOCK = "lock"  # held by the process that works in the folder
CONDITIONS = {  # of a run, beside its settings: what a folder holds if one of them differs
    "processes": "holds a run whose number of processes is {}, now it is {}",
    "computes_in": "holds a run that computes in {}, now it would compute in {}",
    "rendered": "holds a run on clips that were rendered {}, now they are {}",
    "clips": "holds a run on other clips or codes than are there now",
    "validated_frames": "holds a run that was validated on windows of {} frames, now it is {}",
}


def _load_weights(model: nn.Module, stored: Any) -> None:
    """Load stored weights into the model; ValueError unless names and shapes are the model's and values finite."""
    own = model.state_dict()
    if not isinstance(stored, dict) or not all(isinstance(name, str) for name in stored):
        raise ValueError("weights of another network")
    if set(stored) != set(own):
        raise ValueError("weights of another network")
    for name, value in stored.items():
        if not isinstance(value, torch.Tensor) or value.layout != torch.strided or value.shape != own[name].shape:
            raise ValueError(f"{name} is not a tensor of shape {list(own[name].shape)}")
        if value.dtype != own[name].dtype or not bool(torch.isfinite(value).all()):
            raise ValueError(f"{name} holds values that are not finite numbers of the kind {own[name].dtype}")
    model.load_state_dict(stored)


def _alone(value: Any) -> Any:
    """Return the value of a list of one: a protocol names one sensor, and an option a list."""
    return value[0] if isinstance(value, list) and len(value) == 1 else value


@contextlib.contextmanager
def alone_in(folder: Path, doing: str) -> Iterator[None]:
    """Hold the lock of a folder of results; `ValueError` if another process holds it."""
    lock = Lock(folder / LOCK)
    if not lock.acquire():
        raise ValueError(f"{folder}: another process {doing} here; wait for it to end, or choose another folder")
    try:
        yield
    finally:
        lock.delete()


def empty(folder: Path) -> None:
    """Remove all but the lock, which the caller holds; settings.json last, so that the folder stays recognisable."""
    for path in sorted(folder.iterdir(), key=lambda path: path.name == "settings.json"):
        if path.name == "settings.json":
            sync_folder(folder)  # after a power cut nothing is left without it
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif path.name != LOCK:
            path.unlink()


class Run:
    """Folder of a run. `conditions` are values by the keys of CONDITIONS, stored beside the settings."""

    def __init__(self, settings: Settings, conditions: Mapping[str, Any] | None = None) -> None:
        self.settings = settings
        self.folder = Path(settings.out)
        self.conditions = dict(conditions or {})
        self.checkpoint = self.folder / "checkpoint.pt"

    @contextlib.contextmanager
    def open(self, *, force: bool = False) -> Iterator[None]:
        """Make the folder, or check that it holds a run with these settings, and lock it while it is open.

        `force` removes a run that is there. `FileExistsError` if the folder holds other files or a run with other
        settings, `ValueError` while another process trains in it.
        """
        self._check_ours(force)
        self.folder.mkdir(parents=True, exist_ok=True)
        with alone_in(self.folder, "trains"):
            self._check_ours(force)
            if force:
                check_ours(self.folder, OURS)
                empty(self.folder)
            path = self.folder / "settings.json"
            if not path.exists():
                write_json(path, self.settings.to_dict() | self.conditions)
            self._check_settings()
            found = read_json(path)
            if found.get("threads") != self.settings.threads:
                write_json(path, found | {"threads": self.settings.threads})
            yield

    def _check_ours(self, force: bool) -> None:
        folder = self.folder
        if (folder / "settings.json").is_file() or not folder.exists():
            return
        if not folder.is_dir() or any(path.name != LOCK for path in folder.iterdir()):
            if force:
                raise FileExistsError(f"{folder} holds no settings.json; only what this program made is removed")
            raise FileExistsError(f"{folder} exists and is not a training run; choose another")

    def _check_settings(self) -> None:
        wanted = self.settings.to_dict()
        found = read_json(self.folder / "settings.json")
        free = {"out", "workers", "windows", "threads"}
        defaults = {each.name: each.default for each in fields(Settings)}  # of settings that an older run lacks
        for name in wanted:
            if name not in free and _alone(found.get(name, defaults[name])) != _alone(wanted[name]):
                before = "as in its data set" if found.get(name) is None else short(found[name])
                raise Blocked(
                    f"{self.folder} holds a run with {name} {before}, now it is {short(wanted[name])}",
                    "choose another folder, or start again with force=True",
                )
        for name, value in self.conditions.items():
            begun = found.get(name)
            if begun != value:
                raise Blocked(
                    f"{self.folder} {CONDITIONS[name].format(short(begun), short(value))}",
                    "resume it as it began, choose another folder, or start again with force=True",
                )

    def save(self, path: Path, model: nn.Module, optimiser: Optimiser, state: State, **extra: Any) -> None:
        """Write the complete state of the run to one file."""
        content = {
            "model": model.state_dict(),
            "optimiser": optimiser.state_dict(),
            "state": asdict(state),
            "torch_rng": torch.get_rng_state(),
            "cuda_rng": random_states(),
            **extra,
        }
        buffer = io.BytesIO()  # a full disk then raises the system's error, not torch's
        torch.save(content, buffer)
        with buffer.getbuffer() as stored:  # released if writing fails, too: a lent buffer cannot be freed
            write_bytes(path, stored)

    def load(self, model: nn.Module, optimiser: Optimiser) -> State:
        """Load the newest state into model and optimiser; a new state if there is none, ValueError if it is damaged."""
        if not self.checkpoint.exists():
            return State()
        try:
            content = weights.read_torch(self.checkpoint)  # on the CPU, where Adam counts its steps
            if not isinstance(content, dict):
                raise ValueError(f"it holds a {type(content).__name__}")
            state = State.from_dict(content["state"])
            _load_weights(model, content["model"])
            optimiser.load_state_dict(content["optimiser"])
            torch.set_rng_state(content["torch_rng"].cpu())
            set_random_states(content["cuda_rng"])
            return state
        except weights.DAMAGE as error:
            raise Damaged(
                f"{self.checkpoint}: not a state of this run ({weights.short_reason(error)})",
                "start again with force=True",
            ) from None

    def save_weights(self, name: str, model: nn.Module, state: State) -> None:
        """Write NAME.safetensors with the settings in its notes, without folders, because weights files are copied."""
        settings = portable(self.settings)
        notes = {"step": str(state.step), "settings": json.dumps(settings, sort_keys=True)}
        weights.save(model, model.config, self.folder / f"{name}.safetensors", notes)

    def save_history(self, state: State) -> None:
        """Write history.json, one entry per validation; null stands for numbers that are not finite."""
        content = {"settings": self.settings.to_dict(), "history": json_safe(state.history)}
        write_json(self.folder / "history.json", content)


def draw_curve(folder: Path, history: Sequence[Mapping[str, float]]) -> Path | None:
    """Draw curve.png of a run, validation PSNR and loss over minutes; None without any validation."""
    if not history:
        return None
    minutes = [entry["elapsed"] / 60 for entry in history]
    figure = new_figure(6, 3.5)
    axes = figure.subplots()
    axes.plot(minutes, [entry["psnr_matched"] for entry in history], "o-", label="PSNR after the best factor")
    axes.plot(minutes, [entry["psnr"] for entry in history], ".--", label="PSNR raw")
    axes.set_xlabel("minutes")
    axes.set_ylabel("validation PSNR [dB]")
    losses = axes.twinx()
    losses.plot(minutes, [entry["loss"] for entry in history], ":", color="grey")
    losses.set_ylabel("training loss of one batch (dotted)")
    axes.legend(fontsize="small", loc="lower right")
    write_figure(figure, folder / "curve.png")
    return folder / "curve.png"
