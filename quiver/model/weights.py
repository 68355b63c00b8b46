"""Weights in and out: our safetensors files, and checkpoints of the published QUIVER.

Nothing here executes pickled code: our files are safetensors, foreign checkpoints are read by torch with
`weights_only=True`. The published names are facts needed for compatibility (tests/data/published_state_dict.tsv).
"""

import json
import pickle
import re
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as to_safetensors
from torch import Tensor, nn

from qsim.files import write_bytes
from quiver.model.config import Config
from quiver.model.quiver import QUIVER
from quiver.model.unet import UNet, UNetConfig

FORMAT = "quiver-1"  # value of the metadata key "format" in our files
MAX_CONFIG = 10_000  # characters of a configuration
MAX_REASON = 300  # characters of torch's that are shown
DAMAGE = (  # what torch raises for files that hold something else
    *(RuntimeError, EOFError, LookupError, ValueError, TypeError, AttributeError, OverflowError, MemoryError),
    *(RecursionError, pickle.UnpicklingError, zipfile.BadZipFile, NotImplementedError, AssertionError),
)
WRAPPERS = ("state_dict", "model_state_dict", "model", "params", "net")  # keys under which trainers nest a state dict

# Our module -> published prefix, longest first where one begins another.
PUBLISHED = {
    "denoiser.lift": "predenoise.sfe1",
    "denoiser.enter": "predenoise.sfe2",
    "denoiser.block": "predenoise.rdbs.0",
    "denoiser.fuse": "predenoise.gff",
    "denoiser.leave": "predenoise.out",
    "flow.mean": "spynet.mean",
    "flow.deviation": "spynet.std",
    "noisy_features.scale1": "extractor.f1",
    "noisy_features.scale2": "extractor.f2",
    "noisy_features.scale4": "extractor.f3",
    "denoised_features.scale1": "preden_extractor.f1",
    "denoised_features.scale2": "preden_extractor.f2",
    "denoised_features.scale4": "preden_extractor.f3",
    "alignment.offsets": "pa_deform.conv_offset",
    "alignment": "pa_deform",
    "cell.image1": "forward_cell.F_B01",
    "cell.fuse1": "forward_cell.F_B01_fuse",
    "cell.image2": "forward_cell.F_B02",
    "cell.image4": "forward_cell.F_B03",
    "cell.block1": "forward_cell.F_B1.rdb",
    "cell.down1": "forward_cell.F_B1.down_sampling",
    "cell.block2": "forward_cell.F_B2.rdb",
    "cell.down2": "forward_cell.F_B2.down_sampling",
    "cell.join": "forward_cell.F_R.0.rdb",
    "cell.shrink": "forward_cell.F_R.0.shrink",
    "cell.blocks": "forward_cell.F_R.1.RDBs",
    "cell.collect": "forward_cell.F_R.1.conv1x1",
    "cell.smooth": "forward_cell.F_R.1.conv3x3",
    "cell.state": "forward_cell.F_h",
    "attention.enter": "spatial_att.conv",
    "attention.spread": "spatial_att.spat_att.get_qkv.0",
    "attention.qkv": "spatial_att.spat_att.get_qkv.1",
    "attention.project": "spatial_att.spat_att.project_out",
    "attention.leave": "spatial_att.conv1x1",
    "refine4": "recons3",
    "refine": "recons12",
}
# Below those prefixes: patterns of our names and what they are called in the published network.
INSIDE = (
    (re.compile(r"^flow\.levels\.(\d)\."), r"spynet.basic_module.\1.basic_module."),
    (re.compile(r"^fusions\.(\d)\."), lambda match: f"alignfuse_{int(match[1]) + 1}."),
    (re.compile(r"^(alignfuse_\d)\.gate\."), r"\1.fc11."),
    (re.compile(r"^(alignfuse_\d)\.value\."), r"\1.fc12."),
    (re.compile(r"^(alignfuse_\d)\.merge\."), r"\1.fc2."),
    (re.compile(r"^((?:predenoise|forward_cell)\..*)\blayers\.(\d)\."), r"\1dense_layers.\2.conv."),
    (re.compile(r"^((?:predenoise|forward_cell)\..*)\bmerge\."), r"\1conv1x1."),
    (re.compile(r"^(recons\d+)\.enter\."), r"\1.conv1x1."),
    (re.compile(r"^(recons\d+)\.body\."), r"\1.cab.body."),
    (re.compile(r"^(recons\d+)\.gate\."), r"\1.cab.CA.conv_du."),
    (re.compile(r"^(recons\d+)\.hidden\."), r"\1.flast."),
    (re.compile(r"^(recons\d+)\.picture\."), r"\1.out."),
    (re.compile(r"^(recons\d+)\.next_picture\."), r"\1.upconv_out."),
)
ALIAS = re.compile(r"^predenoise\.rdbs\.[1-4]\.")  # the pre-denoiser's five blocks are one


def published_name(name: str) -> str:
    """The published name of one of our entries (of a network without our own extensions)."""
    for ours, theirs in PUBLISHED.items():
        if name == ours or name.startswith(ours + "."):
            name = theirs + name[len(ours) :]
            break
    for pattern, replacement in INSIDE:
        name = pattern.sub(replacement, name)
    return name


def from_published(state: Mapping[str, Tensor]) -> QUIVER:
    """The network with the 335 entries of a published state dict; the width is read from it.

    Aliases may be present or not, but must equal the block they repeat. Raises ValueError for anything else: missing,
    unknown or misshapen entries, values that are not finite, other flow constants than the published ones.
    """
    first = state.get("predenoise.sfe1.weight")
    if not isinstance(first, Tensor) or first.ndim != 4 or first.shape[0] % 16 or not first.shape[0]:
        raise ValueError(
            "not a published QUIVER checkpoint: predenoise.sfe1.weight, whose first side is the width (a multiple of "
            f"16), is {'missing' if first is None else 'of another kind'}; found {len(state)} entries: {_some(state)}"
        )
    with torch.device("meta"):
        network = QUIVER(Config(channels=first.shape[0]))
    expected = network.state_dict()
    names = {published_name(ours): ours for ours in expected}
    _check_names(state, set(names))
    ours = {}
    for theirs, name in names.items():
        value = state[theirs].detach()
        if value.shape != expected[name].shape:
            raise ValueError(
                f"published checkpoint: {theirs} must be {tuple(expected[name].shape)} at width {first.shape[0]}, "
                f"got {tuple(value.shape)}"
            )
        if not value.is_floating_point() or not bool(torch.isfinite(value).all()):
            raise ValueError(f"published checkpoint: {theirs} holds values that are not finite numbers")
        ours[name] = value.clone()
    for name in ("flow.mean", "flow.deviation"):
        _check_constant(name, ours[name])
    network.load_state_dict(ours, assign=True)
    return network.requires_grad_(True)


def _check_names(state: Mapping[str, Tensor], wanted: set[str]) -> None:
    missing = sorted(wanted - state.keys())
    if missing:
        raise ValueError(f"published checkpoint: {len(missing)} entries are missing, among them {_some(missing)}")
    unknown = []
    for name, value in state.items():
        if not isinstance(value, Tensor):
            raise ValueError(f"published checkpoint: {name} is a {type(value).__name__}, not a tensor")
        if not ALIAS.match(name):
            unknown += [] if name in wanted else [name]
            continue
        original = ALIAS.sub("predenoise.rdbs.0.", name)
        if original not in wanted:
            unknown.append(name)
        elif not torch.equal(value, state[original]):
            raise ValueError(
                f"published checkpoint: {name} differs from {original}; the published network has one block there"
            )
    if unknown:
        raise ValueError(f"published checkpoint: {len(unknown)} entries are unknown, among them {_some(unknown)}")


def _check_constant(name: str, value: Tensor) -> None:
    constant = 0.449 if name == "flow.mean" else 0.226
    if abs(float(value) - constant) > 1e-6:
        raise ValueError(f"published checkpoint: {published_name(name)} must be {constant}, got {float(value)}")


def convert_weights(source: Path, target: Path) -> QUIVER:
    """Turn a published checkpoint (.pt, .pth, .ckpt, .safetensors) into our file; returns the network written.

    Raises ValueError for anything that is no such checkpoint and FileExistsError where `target` exists.
    """
    if target.exists():
        raise FileExistsError(f"{target} exists; choose another name or remove it")
    network = from_published(_read_foreign(source))
    save(network, network.config, target, notes={"converted_from": source.name})
    return network


def _read_foreign(path: Path) -> dict[str, Tensor]:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such checkpoint")
    if path.suffix == ".safetensors":
        return _read_safetensors(path)[0]
    try:
        content = read_torch(path)
    except ValueError as error:
        raise ValueError(
            f"{path}: torch cannot read it as plain tensors ({error}); pickled programs are never run: "
            "save the bare state dict with torch.save(model.state_dict(), FILE) and convert that"
        ) from None
    for key in WRAPPERS:
        if isinstance(content, Mapping) and isinstance(content.get(key), Mapping):
            content = content[key]
    if not isinstance(content, Mapping) or not all(isinstance(name, str) for name in content):
        raise ValueError(f"{path}: expected a dictionary of named tensors, found {type(content).__name__}")
    return {name.removeprefix("module."): value for name, value in content.items()}


def read_torch(path: Path, device: torch.device | str = "cpu") -> Any:
    """Tensors and plain values of a file of torch, nothing executed; ValueError with a short reason for any other file.

    A zip whose parts are said to be larger than the file is refused unread: torch does not compress.
    """
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                told = sum(part.file_size for part in archive.infolist())
            if told > path.stat().st_size:
                raise ValueError(f"parts of {told} bytes in a file of {path.stat().st_size}")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # about pickle dialects that end as the error below
            return torch.load(path, map_location=device, weights_only=True)
    except DAMAGE as error:
        raise ValueError(short_reason(error)) from None


def short_reason(error: BaseException) -> str:
    """The first line of torch's explanation, at most MAX_REASON characters."""
    lines = str(error).strip().splitlines()
    return lines[0][:MAX_REASON] if lines else type(error).__name__


def save(network: nn.Module, config: Config | UNetConfig, path: Path, notes: Mapping[str, str] | None = None) -> None:
    """Write weights and configuration as safetensors, whole or not at all; `notes` become metadata."""
    if path.suffix != ".safetensors":
        raise ValueError(f"weights are written as .safetensors, got {path.name}")
    metadata = {
        **(notes or {}),
        "format": FORMAT,
        "network": type(network).__name__,
        "config": json.dumps(config.to_dict()),
    }
    tensors = {name: value.detach().cpu().contiguous() for name, value in network.state_dict().items()}
    write_bytes(path, to_safetensors(tensors, metadata))


def load(path: Path) -> QUIVER | UNet:
    """The network stored by `save`, on the CPU, in evaluation mode; ValueError for any other file.

    Layers are made without memory, from a configuration whose numbers are bounded (config.py): what a file can ask for
    is about its own size.
    """
    tensors, metadata = _read_safetensors(path)
    if metadata.get("format") != FORMAT:
        raise ValueError(f"{path}: not weights of this program (no format {FORMAT!r}); see `quiver convert-weights`")
    try:
        if len(metadata["config"]) > MAX_CONFIG:
            raise ValueError(f"a configuration of {len(metadata['config'])} characters")
        values = json.loads(metadata["config"])
        with torch.device("meta"):
            network = _build(metadata["network"], values)
        for name, value in network.state_dict().items():
            if name in tensors and tensors[name].dtype != value.dtype:
                raise ValueError(f"{name} holds {tensors[name].dtype}, the network {value.dtype}")
        network.load_state_dict(tensors, assign=True)
    except DAMAGE as error:
        reason = " ".join(str(error).split())[:MAX_REASON]
        raise ValueError(f"{path}: weights and configuration do not fit ({reason})") from None
    return network.requires_grad_(True).eval()


def metadata_of(path: Path) -> dict[str, str]:
    """The notes of a safetensors file; FileNotFoundError or ValueError for any other file."""
    return _read_safetensors(path)[1]


def annotate(path: Path, notes: Mapping[str, str]) -> None:
    """Add notes to a weights file of ours; its tensors stay the same, bit for bit."""
    tensors, metadata = _read_safetensors(path)
    if metadata.get("format") != FORMAT:
        raise ValueError(f"{path}: not weights of this program (no format {FORMAT!r}); see `quiver convert-weights`")
    write_bytes(path, to_safetensors(tensors, metadata | dict(notes)))


def _build(kind: str, values: dict[str, object]) -> QUIVER | UNet:
    if kind == "QUIVER":
        return QUIVER(Config.from_dict(values))
    if kind == "UNet":
        return UNet(UNetConfig.from_dict(values))
    raise ValueError(f"no network is called {kind[:60]!r}")


def _read_safetensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such weights file")
    try:
        with safe_open(path, framework="pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, dict(file.metadata() or {})  # noqa: SIM118
    except SafetensorError as error:
        raise ValueError(f"{path}: not a safetensors file ({error})") from None


def _some(names: object, count: int = 3) -> str:
    listed = [str(name) for name in names]  # type: ignore[attr-defined]
    return ", ".join(listed[:count]) + (", ..." if len(listed) > count else "") if listed else "none"
