"""Holds the sizes of all measurements: those of a GPU by default; tests make them small."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Sizes:
    """How much is measured."""

    height: int = 512  # px, of frames that are sensed, rendered and restored
    width: int = 1024
    sensor_pixels: int = 1 << 24  # of a draw
    rounds: int = 7  # of timing
    families: tuple[str, ...] = ("fence", "glass", "glossy", "room")  # scenes that budgets were not tuned on
    frames: int = 5  # that are timed with a budget
    psnr: float = 40.0  # dB
    check_height: int = 128  # px, of the comparison with a converged frame
    check_width: int = 256
    reference_samples: int = 2048
    train_families: tuple[str, ...] = ("fan", "tumble", "drums", "text", "gears", "room")  # the first: validation too
    train_psnr: float = 36.0  # dB
    train_seeds: int = 2  # clips of each family of the training set
    train_frames: int = 24
    train_height: int = 192  # px
    train_width: int = 256
    crop: int | None = None  # px; None: that of the protocol
    batch: int | None = None  # None: that of the protocol
    steps: int = 1000  # of every training
    step_batches: tuple[int, ...] = (8, 16, 32, 64, 128)  # windows of the steps that are timed without a loader
    step_frames: tuple[int, ...] = (11, 21)  # of their windows
    compiled: tuple[str, ...] = ("off", "kernels", "graphs")  # ways of torch.compile
    compiled_batch: int = 16  # windows of these steps
    step_crop: int = 64  # px
    counted_crop: int = 16  # px, of the steps whose operators are counted
    step_height: int = 256  # px, of their clips
    step_width: int = 256
    step_count: int = 10  # steps of a round
    window_batch: int = 32  # windows of the steps whose loader is timed
    peak_side: int = 8192  # of the matrices whose product is the peak
    learn_recipe: str = "scenes/starter.toml"  # of the repository, that is rendered while a network learns
    learn_on_gpu: bool = True  # alone
    learn_frames: int = 21  # of its windows
    learn_batch: int = 32
    learn_precision: str = "bfloat16"
    learn_steps: int = 20_000  # at most
    copied_batches: int = 40  # batches that are timed for every way of copying
    workers: int = 8  # processes that draw windows, at most one less than the cores
    restored: int = 16  # frames of a network that are timed on a GPU
    restored_slow: int = 2  # frames that are timed on a CPU
    compared_side: int = 64  # px, of the frames on which precisions are compared
