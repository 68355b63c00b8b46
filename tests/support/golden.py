"""Compares networks with golden arrays: weights by rule, every stage in float64. Makes small networks for tests.

    python tests/support/golden.py NAME GOLDEN.npz TABLE.tsv [--prefix P]

builds the weights of network NAME from the table of published names, runs it in float64 on the inputs that the file
holds, at whatever size they have, and prints one JSON object: max |ours - golden| / std(golden) of every key. The exit
code is 1 if a key is not computed, has another shape or is not finite (its error is then null), and 2, with one line,
for a file or table that cannot be used. NAME is emvd, flornn, memdeblur, rvrt, spk2imgnet or quiver.

A network contributes a file `tests/support/golden_NAME.py` with

- `stages(arrays, weights) -> {key: tensor or array}`. `arrays` are those of the file (codes 0..7 and other inputs).
  `weights` has a float64 tensor for every published name, without the `const` entries of the table. It builds our
  network, loads it (`load_published`), and returns all keys of the golden file but the inputs, in their published
  shapes and channel slices, for any batch, frame count and size. Forward hooks record stages (`Recorder`);
- `INPUTS`: the names of the file's arrays that are inputs;
- `FLAT`, true where codes may be [B, T, H, W] instead of [B, T, 1, H, W];
- `MULTIPLE`, where the port takes only sides that it divides;
- `START`, where the table has the fill `init`: published name -> start value;
- `small() -> network`: a float64 network in evaluation mode, of the smallest width, with weights of natural size
  (`fill_by_rule`). tests/quiver/model/rivals/test_all.py runs over all of them.

Tests call `errors(name, arrays, table, prefix)`. `golden_files(name)` lists the committed file (at most 300 kB, from
`cut`) and the full one in ../shared/rivals, if that is available. `DATA/NAME_state_dict.tsv` is the table.
"""

import argparse
import importlib
import json
import math
import sys
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import torch
from machines import eps, walk
from torch import Tensor, nn

from qsim.files import decoding_errors
from quiver.model.config import Config
from quiver.model.published_weights import published_name
from quiver.model.quiver import QUIVER

DATA = Path(__file__).parents[1] / "data"
SHARED = Path(__file__).parents[3] / "shared" / "rivals"  # the specification's full files, where they are available
TINY = Config(channels=2, deformable_groups=1, denoiser_growth=2, flow_channels=(2,))  # for fast tests
SMALL = Config(channels=4, deformable_groups=2, denoiser_growth=4, flow_channels=(4, 4))
TOP = 7  # the largest code of 3 bits
CONSTANTS = {"spynet.mean": 0.449, "spynet.std": 0.226}


def rule(name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return the values of a weight, a function of its published name and shape."""
    w = np.random.default_rng(zlib.crc32(name.encode())).standard_normal(shape, dtype=np.float32)
    if len(shape) == 1:
        return np.float32(0.05) * w
    return w * np.float32(0.8 / math.sqrt(math.prod(shape[1:])))


def published_state() -> dict[str, Tensor]:
    """All 335 entries of QUIVER at width 16, float32."""
    constants = {name: torch.full((1, 1, 1, 1), value) for name, value in CONSTANTS.items()}
    return {**weights_by_table(DATA / "published_state_dict.tsv", dtype=torch.float32), **constants}


def network(channels: int, dtype: torch.dtype) -> QUIVER:
    """Return the published network of any width with weights by rule."""
    model = QUIVER(Config(channels=channels))
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            parameter.copy_(torch.from_numpy(rule(published_name(name), tuple(parameter.shape))))
    return model.to(dtype).eval()


def fill_by_rule(model: nn.Module) -> nn.Module:
    """Set weights by rule in any network of ours, so that nothing is near zero, offsets and masks included."""
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            parameter.copy_(torch.as_tensor(rule(name, tuple(parameter.shape))))
    return model


def draw(*shape: int, dtype: torch.dtype = torch.float64, seed: int = 0) -> Tensor:
    """Return random codes 0..7, over 7, as the networks take them."""
    return torch.randint(0, 8, shape, generator=torch.Generator().manual_seed(seed)).to(dtype) / 7


def lively(config: Config, dtype: torch.dtype = torch.float64) -> QUIVER:
    """Return a network with weights by rule, so that every stage contributes."""
    network = fill_by_rule(QUIVER(config)).to(dtype).eval()
    assert isinstance(network, QUIVER)
    return network


# Golden files


def fill_value(name: str, shape: tuple[int, ...], fill: str, prefix: str, start: Mapping[str, object]) -> np.ndarray:
    """One entry of a table of published names, float32: a function of prefix, name, shape and fill."""
    if fill == "zero":
        return np.zeros(shape, np.float32)
    w = np.random.default_rng(zlib.crc32((prefix + name).encode())).standard_normal(shape, dtype=np.float32)
    if fill.startswith("fan"):
        return w * np.float32(float(fill[3:]) / math.sqrt(math.prod(shape[1:])))
    if fill == "bias":
        return np.float32(0.05) * w
    if fill == "one":
        return np.float32(1) + np.float32(0.05) * w
    if fill == "slope":
        return np.float32(0.25) + np.float32(0.05) * w
    if fill == "init":
        return np.asarray(start[name], np.float32).reshape(shape) + np.float32(0.1) * w
    raise ValueError(f"the fill of {name} is {fill}; known are fanGAIN, bias, one, slope, init, zero and const")


def weights_by_table(
    table: Path, prefix: str = "", start: Mapping[str, object] | None = None, dtype: torch.dtype = torch.float64
) -> dict[str, Tensor]:
    """All entries of a table but constants; a table without the column `fill` (QUIVER's) is filled like `rule`."""
    state: dict[str, Tensor] = {}
    with decoding_errors(table, "a table of names, shapes and kinds"):
        for line in table.read_text().splitlines():
            if line.startswith("#") or not line.strip():
                continue
            name, size, kind, *rest = line.split("\t")
            if kind.startswith("same tensor as "):
                state[name] = state[kind.removeprefix("same tensor as ")]
                continue
            shape = tuple(int(side) for side in size.split("x")) if size not in ("", "scalar", "()") else ()
            if rest:
                fill = rest[0]
            elif kind == "buffer":
                fill = "const"
            else:
                fill = "bias" if len(shape) == 1 else "fan0.8"
            if fill != "const":
                value = np.asarray(fill_value(name, shape, fill, prefix, start or {}))
                state[name] = torch.from_numpy(value).to(dtype)
    return state


class Recorder:
    """Keeps every result of named modules: `Recorder({"key": module})`, then `recorder["key"][n]` of its n-th call."""

    def __init__(self, watched: Mapping[str, nn.Module]) -> None:
        self.calls: dict[str, list] = {key: [] for key in watched}
        for key, module in watched.items():
            module.register_forward_hook(lambda _module, _inputs, out, key=key: self.calls[key].append(out))

    def __getitem__(self, key: str) -> list:
        return self.calls[key]


def compare(ours: Mapping[str, object], golden: Mapping[str, np.ndarray]) -> dict[str, float | None]:
    """max |ours - golden| / std(golden) of every key; None where ours is missing, of another shape, or not finite."""
    result: dict[str, float | None] = {}
    for key, array in golden.items():
        wanted = array.astype(np.float64)
        found = np.asarray(ours[key], np.float64) if key in ours else np.empty(0)
        if found.shape != wanted.shape or not found.size or not np.isfinite(found - wanted).all():
            result[key] = None
            continue
        result[key] = float(np.abs(found - wanted).max() / (wanted.std() or 1.0))
    return result


def errors(name: str, golden: Mapping[str, np.ndarray], table: Path, prefix: str = "") -> dict[str, float | None]:
    """Error of every key of a golden file that is no input, from a float64 run with weights by rule.

    `ValueError` and errors of torch for arrays and tables that do not fit; `KeyError` if one lacks an entry.
    """
    network = importlib.import_module(f"golden_{name}")
    codes = golden["codes"]
    shaped = (codes.ndim == 5 and codes.shape[2] == 1) or (codes.ndim == 4 and getattr(network, "FLAT", False))
    if not shaped or codes.dtype.kind not in "iuf" or not codes.size or not np.isfinite(codes).all():
        shapes = "[B, T, H, W] or [B, T, 1, H, W]" if getattr(network, "FLAT", False) else "[B, T, 1, H, W]"
        raise ValueError(f"codes are numbers {shapes}, got {codes.dtype} {list(codes.shape)}")
    if (codes < 0).any() or (codes > TOP).any() or (codes != np.floor(codes)).any():
        raise ValueError(f"codes are whole numbers 0 to {TOP}, got some of {codes.min()} to {codes.max()}")
    multiple = getattr(network, "MULTIPLE", 1)
    height, width = codes.shape[-2:]
    if height % multiple or width % multiple:
        raise ValueError(f"{name} takes frames whose sides {multiple} divides, got {height} x {width}")
    if not golden.keys() - set(network.INPUTS):
        raise ValueError(f"nothing to compare: the file holds {', '.join(golden)} alone")
    weights = weights_by_table(table, prefix, getattr(network, "START", None))
    with torch.no_grad():
        ours = network.stages(dict(golden), weights)
    wanted = {key: array for key, array in golden.items() if key not in network.INPUTS}
    return compare({key: torch.as_tensor(value).numpy() for key, value in ours.items()}, wanted)


def terms_of(table: Path) -> int:
    """How many terms the sums of a network have, one layer after the other: what one output of each weight sums."""
    rows = [line.split("\t") for line in table.read_text().splitlines() if line.strip() and not line.startswith("#")]
    shapes = [row[1].split("x") for row in rows if not row[2].startswith("same tensor as ")]
    return sum(math.prod(map(int, shape[1:])) for shape in shapes if len(shape) > 1)


def beyond(
    found: Mapping[str, float | None], golden: Mapping[str, np.ndarray], table: Path, dtype: type = np.float64
) -> dict[str, tuple[float | None, float]]:
    """Errors of a run in `dtype` that are larger than the rounding of the stored array and the walk of the sums."""
    sums = walk(terms_of(table), dtype)
    wrong = {}
    for key, error in found.items():
        wanted = golden[key].astype(np.float64)
        stored = eps(golden[key].dtype) / 2 * np.abs(wanted).max() / wanted.std()
        if error is None or not error <= stored + sums:
            wrong[key] = error, float(stored + sums)
    return wrong


def golden_files(name: str) -> list[Path]:
    """The committed golden file of a network, and the full one where the specification is available."""
    return [DATA / f"golden_{name}.npz", *(path for path in [SHARED / f"golden_{name}.npz"] if path.is_file())]


def slow_beyond_the_first(files: list[Path]) -> list[object]:
    """Parameters of a test: `make test` compares the committed file alone."""
    return [files[0], *(pytest.param(path, marks=pytest.mark.slow) for path in files[1:])]


def arrays_of(path: Path) -> dict[str, np.ndarray]:
    """All arrays of a golden file; `ValueError` for another file, `FileNotFoundError` for none."""
    with decoding_errors(path, "an archive of arrays (.npz)"), np.load(path) as file:
        return dict(file)


def cut(source: Path, target: Path, keys: list[str]) -> None:
    """Write the golden file of some keys."""
    arrays = arrays_of(Path(source))
    np.savez_compressed(target, **{key: arrays[key] for key in keys})


def refused(why: str) -> int:
    """Print why files cannot be compared, in one line; return the exit code."""
    print(f"golden: {' '.join(why.split())}", file=sys.stderr)
    return 2


def main(arguments: list[str] | None = None) -> int:
    """The program above."""
    parser = argparse.ArgumentParser(description="compare a network with golden arrays")
    parser.add_argument("name", choices=["emvd", "flornn", "memdeblur", "rvrt", "spk2imgnet", "quiver"])
    parser.add_argument("golden", type=Path)
    parser.add_argument("table", type=Path)
    parser.add_argument("--prefix", default="")
    given = parser.parse_args(arguments)
    try:
        found = errors(given.name, arrays_of(given.golden), given.table, given.prefix)
    except KeyError as error:
        return refused(f"{error} is missing; give the golden file and the table of {given.name}")
    except (OSError, ValueError, IndexError, RuntimeError) as error:
        return refused(str(error))
    print(json.dumps(found, indent=1))
    return int(any(error is None for error in found.values()))


if __name__ == "__main__":
    raise SystemExit(main())
