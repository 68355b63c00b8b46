"""Trains all networks by one loop."""

from typing import TYPE_CHECKING

from qsim.lazy_imports import lazy_names

if TYPE_CHECKING:
    from quiver.training.ablation import run_ablation
    from quiver.training.loop import train
    from quiver.training.run_folder import Run
    from quiver.training.settings import Settings

__all__ = ["Run", "Settings", "run_ablation", "train"]

__getattr__ = lazy_names(
    __name__,
    {
        "Run": "run_folder",
        "Settings": "settings",
        "run_ablation": "ablation",
        "train": "loop",
    },
)
