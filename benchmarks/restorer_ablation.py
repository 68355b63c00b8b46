"""Measures what each idea of mergenet brings: the same training without it, equal steps, two seeds, one row each.

    python benchmarks/restorer_ablation.py out/photos out/restorer out/restorer_test           # rows that are missing
    python benchmarks/restorer_ablation.py out/photos out/restorer out/restorer_test --rows all,adam
    python benchmarks/restorer_ablation.py out/tiny out/tiny out/tiny --tiny --out out/rows    # seconds: a test of this

A row is RESULTS/NAME-SEED.json, written when it is complete and made once. Windows are drawn once, into WORK (12 GB),
and seen three times (STEPS x BATCH / WINDOWS), flipped at random. All rows make equally many steps, so busy cores
change no score: as many as 20 minutes on two quiet threads allow.
Scores are of test clips, which trained and chose nothing.
"""

from __future__ import annotations

import argparse
import math
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import result_page
import torch
from numpy import ndarray as Array
from rows import keep_apart, restorer_options
from torch import Tensor
from torch.utils.data import DataLoader

from qsim.files import VERSION, read_json, write_bytes, write_json
from qsim.tables import markdown_table
from quiver.baselines import path_merge
from quiver.baselines.paths.motion_paths import Moves
from quiver.data.clips import open_clips
from quiver.data.illumination import Illumination
from quiver.data.windows import Windows, WindowSettings
from quiver.model.mergenet import MergeNet, MergeNetConfig
from quiver.training import merge_training
from quiver.training.optimiser import Optimiser

FORMAT = "quiver-restorer-ablation-2"
SEEDS = (0, 1)
PROTOCOL = merge_training.PROTOCOLS["quick"]
TEST_LIGHTS = tuple(Illumination.of("quiver-physical", ppp, bits) for bits in (1, 3, 7) for ppp in (0.5, 3.25, 26.0))
GROUPS = slice(7, 13)  # channels of merge_inputs.py
PICTURES = slice(1, 4)
MAPS = slice(5, 7)
REPORT = 10  # scores of a curve
LIMITS = """Each row leaves out one idea and trains as long: it tells what an idea brings at this length, not after
days. The spread of two seeds is the only measure of chance here: differences within it mean nothing."""


@dataclass(frozen=True)
class Variant:
    """What a row changes."""

    text: str
    windows: str = "both"  # photographs, rendered, both, still: merged without motion, or one: 3.25 PPP, 3 bits
    without: slice | None = None  # channels that are zeros
    kind: str = "muon"
    rate: float = 3e-3
    loss: str = "decibel"  # or l1, of light over the peak
    width: int = 40


VARIANTS = {
    "all": Variant("all ideas"),
    "no-motion": Variant("merged without motion", windows="still"),
    "no-groups": Variant("without the six groups of moved frames", without=GROUPS),
    "no-pictures": Variant("without the single frame, the nearest three and the unmoved window", without=PICTURES),
    "no-maps": Variant("without the maps of noise and light", without=MAPS),
    "one-light": Variant("trained at 3.25 PPP and 3 bits only", windows="one"),
    "l1": Variant("loss: mean absolute error of light over the peak", loss="l1"),
    "adam": Variant("Adam with a rate of 1.5e-3", kind="adam", rate=1.5e-3),
    "photographs": Variant("photographs only", windows="photographs"),
    "rendered": Variant("rendered clips only", windows="rendered"),
    "half": Variant("half the width", width=20),
}


@dataclass(frozen=True)
class Size:
    """How much every row gets."""

    windows: int = 8000
    steps: int = 4000
    batch: int = 6
    crop: int = 96  # px
    test: int = 4  # windows of each test clip and light


TINY = Size(windows=8, steps=6, batch=2, crop=32, test=1)


def main(words: list[str] | None = None) -> int:
    args = options().parse_args(words)
    size = TINY if args.tiny else Size()
    names = args.rows.split(",")
    torch.set_num_threads(1)
    try:
        args.work = keep_apart("restorer_ablation", args.out, args.work, trial=args.tiny)
        for name in names:
            if name not in VARIANTS:
                raise ValueError(f"no row is called {name!r}; known are {', '.join(VARIANTS)}")
        for name, seed in ((name, seed) for seed in SEEDS for name in names):
            path = args.out / f"{name}-{seed}.json"
            if not path.exists():
                row = learned(VARIANTS[name], seed, args, size)
                args.out.mkdir(parents=True, exist_ok=True)
                write_json(path, {"format": FORMAT, "quiver": VERSION, "name": name, "size": vars(size)} | row)
                print(f"{path}: written", flush=True)
            elif read_json(path)["format"] != FORMAT:
                raise ValueError(f"{path}: was made from other merged frames by an earlier program; give --out")
            elif read_json(path)["size"] != vars(size):
                raise ValueError(f"{path}: was made with another size; choose another --out, or remove it")
            write_table(args.out)
    except (ValueError, OSError) as error:
        print(f"restorer_ablation: {error}", file=sys.stderr)
        return 2
    return 0


def options() -> argparse.ArgumentParser:
    data = {
        "photographs": "data set of warped photographs, with a train split",
        "rendered": "data set of scenes/restorer.toml, with a train split",
        "test": "data set of scenes/restorer_test.toml",
    }
    parser = restorer_options(__doc__, "restorer_ablation", data)
    parser.add_argument("--rows", default=",".join(VARIANTS), help="comma-separated (default all)")
    return parser


# ---- Windows


def stored(kind: str, split: str, args: argparse.Namespace, size: Size) -> dict[str, Array]:
    """Return windows of a kind, name -> array [N, ...]; they are drawn if WORK does not hold them."""
    folder = args.work / f"{kind}-{split}-{size.windows}-{size.crop}"
    if not folder.exists():
        part = folder.with_name(folder.name + ".part")
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        draw(kind, split, args, size, part)
        part.rename(folder)
    elif read_json(folder / "data.json") != sources(args):
        raise ValueError(f"{folder}: holds windows of other data sets; choose another --work, or remove it")
    return {path.stem: np.load(path, mmap_mode="r") for path in sorted(folder.glob("*.npy"))}


def sources(args: argparse.Namespace) -> dict[str, str]:
    """Return where the data sets are."""
    return {name: str(getattr(args, name).resolve()) for name in ("photographs", "rendered", "test")}


def draw(kind: str, split: str, args: argparse.Namespace, size: Size, folder: Path) -> None:
    """Write windows of a kind to FOLDER/NAME.npy."""
    write_json(folder / "data.json", sources(args))
    folders = [args.test] if split == "test" else [args.photographs, args.rendered]
    folders = {"photographs": folders[:1], "rendered": folders[1:]}.get(kind, folders) if split == "train" else folders
    clips = [clip for data in folders for clip in open_clips(data, split)]
    if not clips:
        raise ValueError(f"{folders[0]}: no finished clip in split '{split}'; finish `qsim generate`")
    lights = (
        TEST_LIGHTS
        if split == "test"
        else tuple(
            Illumination.of(sensor, ppp, bits)
            for sensor in PROTOCOL["sensor"]
            for bits in PROTOCOL["bits"]
            for ppp in PROTOCOL["ppp"]
        )
    )
    if kind == "one":
        lights = (Illumination.of("quiver-physical", 3.25, 3),)
    settings = WindowSettings(crop=size.crop, lights=lights, seed=1 if split == "test" else 0, flips=False)
    windows = Windows(clips, settings, prepare=merge_training.prepare)
    count = len(clips) * len(lights) * size.test if split == "test" else size.windows
    moves = still if kind == "still" else path_merge.moves
    with mock.patch.object(path_merge, "moves", moves):
        loader = DataLoader(windows, batch_size=None, sampler=range(count), num_workers=args.workers)
        files: dict[str, Array] = {}
        for n, window in enumerate(loader):
            for name, value in kept(window).items():
                if name not in files:
                    shape = (count, *value.shape)
                    files[name] = np.lib.format.open_memmap(folder / f"{name}.npy", "w+", value.dtype, shape)
                files[name][n] = value
            if n % 1000 == 999:
                print(f"{folder}: {n + 1} of {count} windows", flush=True)


def still(pyramid: Any, offsets: Any, codes: Tensor, deviation: Tensor) -> Moves:
    """Return that nothing moves: `quiver.baselines.paths.motion_paths.moves` otherwise."""
    nothing = torch.zeros(len(codes), 2, *(2 * side for side in codes.shape[2:]))
    return Moves((nothing, nothing), torch.zeros(*codes.shape[:2], 2, 3))


def kept(window: dict[str, Any]) -> dict[str, Array]:
    """Return what a step needs of a window."""
    middle = window["target"].shape[0] // 2
    return {
        "channels": window["channels"].numpy().astype(np.float16),
        **{name: window[name].numpy() for name in ("phi", "deviation", "top", "table")},
        "target": window["target"][middle, 0].numpy(),
        "unit": np.float32(window["white"] / window["peak"]),
        "ppp": np.float32(window["ppp"]),
    }


# ---- Training


def learned(variant: Variant, seed: int, args: argparse.Namespace, size: Size) -> dict[str, Any]:
    """Return curve and scores of one row."""
    if variant.windows == "both":
        halves = [stored(kind, "train", args, size) for kind in ("photographs", "rendered")]
    else:
        halves = [stored(variant.windows, "train", args, size)] * 2
    test = stored("still" if variant.windows == "still" else "both", "test", args, size)
    torch.manual_seed(seed)
    network = MergeNet(MergeNetConfig(width=variant.width))
    optimiser = Optimiser(network, variant.kind, variant.rate, (0.9, 0.99))
    batches = order(size, seed)
    curve = []
    for step in range(size.steps):
        batch = turned(pick(halves, next(batches)), (seed, step))
        error_of(network, batch, variant).mean().backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), PROTOCOL["clip_norm"])
        optimiser.step(variant.rate * min(1, (step + 1) / 100) * (1 + math.cos(math.pi * step / size.steps)) / 2)
        network.zero_grad()
        if (step + 1) % -(-size.steps // REPORT) == 0 or step + 1 == size.steps:
            curve.append({"step": step + 1, "psnr": float(np.mean(scores(network, test, variant)))})
    psnr = scores(network, test, variant)
    ppp = np.asarray(test["ppp"])
    levels = {f"{low:g} to {high:g}": float(psnr[(ppp >= low) & (ppp < high)].mean()) for low, high in LEVELS}
    return {"text": variant.text, "seed": seed, "psnr": float(psnr.mean()), "by_light": levels, "curve": curve}


LEVELS = ((0.0, 1.5), (1.5, 10.0), (10.0, 100.0))  # photons per pixel of the window


def order(size: Size, seed: int) -> Iterator[list[int]]:
    """Yield the windows of batches: half of the photographs and half of the rendered ones in a pass, in new order."""
    rng = np.random.default_rng(seed)
    waiting: list[int] = []
    while True:
        if len(waiting) < size.batch:
            waiting += rng.permutation(size.windows).tolist()
        yield [waiting.pop() for _ in range(size.batch)]


def pick(halves: list[dict[str, Array]], numbers: list[int]) -> dict[str, Tensor]:
    """Return windows: even numbers of the first half, odd ones of the second."""
    return {name: torch.from_numpy(np.stack([halves[n % 2][name][n] for n in numbers])).float() for name in halves[0]}


def turned(batch: dict[str, Tensor], key: tuple[int, int]) -> dict[str, Tensor]:
    """Return a batch in one of the eight flips and quarter turns."""
    turn = int(np.random.default_rng(key).integers(8))

    def one(picture: Tensor) -> Tensor:
        picture = picture.flip(-1) if turn >= 4 else picture
        return torch.rot90(picture, turn % 4, (-2, -1))

    return {name: one(value) if value.ndim >= 3 else value for name, value in batch.items()}


def light_of(network: MergeNet, batch: dict[str, Tensor], variant: Variant) -> tuple[Tensor, Tensor]:
    """Return restored and true light over the peak [B, h, w]."""
    channels = batch["channels"].clone()
    if variant.without is not None:
        channels[:, variant.without] = 0
    with torch.autocast("cpu", torch.bfloat16):
        correction = network(channels)[:, 0]
    phi = batch["phi"] + batch["deviation"] * correction.float()
    unit = batch["unit"][:, None, None]
    return merge_training.light_of(phi, batch["top"], batch["table"]) * unit, batch["target"] * unit


def error_of(network: MergeNet, batch: dict[str, Tensor], variant: Variant) -> Tensor:
    """Return the loss of every window [B]."""
    light, target = light_of(network, batch, variant)
    if variant.loss == "l1":
        return (light - target).abs().mean((1, 2))
    return merge_training.log_error(light, target)


def scores(network: MergeNet, test: dict[str, Array], variant: Variant) -> Array:
    """Return the PSNR [dB] of every test window."""
    found = []
    with torch.no_grad():
        for n in range(0, len(test["ppp"]), 12):
            batch = {name: torch.from_numpy(np.array(values[n : n + 12])).float() for name, values in test.items()}
            light, target = (x.clamp(0, 1) for x in light_of(network, batch, variant))
            found.append(-10 * (light - target).square().mean((1, 2)).log10())
    return torch.cat(found).numpy()


# ---- Tables


def write_table(out: Path) -> None:
    """Write OUT.md from the rows that exist."""
    rows = [read_json(path) for path in sorted(out.glob("*.json"))]
    table = []
    for name, variant in VARIANTS.items():
        runs = [row for row in rows if row["name"] == name]
        if runs:
            told = [difference(runs, rows, lambda row: row["psnr"])]
            told += [difference(runs, rows, lambda row, k=key: row["by_light"][k]) for key in runs[0]["by_light"]]
            table.append((variant.text, " / ".join(f"{row['psnr']:.2f}" for row in runs), *told))
    size = rows[0]["size"]
    levels = [f"{key} PPP" for key in rows[0]["by_light"]]
    command = "restorer_ablation.py out/photos out/restorer out/restorer_test"
    text = result_page.head("What each idea of mergenet brings", command)
    text += [
        f"{size['steps']} steps of {size['batch']} windows of {size['crop']} x {size['crop']} px from "
        f"{size['windows']} windows. Mean PSNR in dB on windows of the test clips, peak 2.5 times the mean light, "
        "1, 3 and 7 bits at 0.5, 3.25 and 26 photons per pixel.",
        "",
    ]
    head = ("trained", "seeds", "difference from all", *levels)
    text += [*markdown_table(table, head), "", LIMITS, ""]
    write_bytes(out.with_suffix(".md"), "\n".join(text).encode())


def difference(runs: list[dict[str, Any]], rows: list[dict[str, Any]], of: Callable[[dict[str, Any]], float]) -> str:
    """Return the mean difference from the rows called `all` with the same seeds as text, with its spread."""
    whole = {row["seed"]: of(row) for row in rows if row["name"] == "all"}
    apart = [of(row) - whole[row["seed"]] for row in runs if row["seed"] in whole]
    if not apart:
        return ""
    return f"{np.mean(apart):+.2f}" + (f" ± {np.ptp(apart) / 2:.2f}" if len(apart) > 1 else "")


if __name__ == "__main__":
    sys.exit(main())
