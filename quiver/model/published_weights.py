"""Converts checkpoints of the published QUIVER to our networks and weights files, and loads those of compared networks.

The published names are facts needed for compatibility (tests/data/published_state_dict.tsv). No pickled code is
executed.
"""

import re
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from quiver.model.config import Config
from quiver.model.quiver import QUIVER
from quiver.model.weights import FORMAT, read_safetensors, read_torch, save

WRAPPERS = ("state_dict", "model_state_dict", "model", "params", "net")  # around a state dict

# Our module: published prefix; a name that begins another one comes after it.
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
# Below those prefixes: patterns of our names, and the published names.
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
    """Return the published name of an entry of QUIVER's state dict."""
    for ours, theirs in PUBLISHED.items():
        if name == ours or name.startswith(ours + "."):
            name = theirs + name[len(ours) :]
            break
    for pattern, replacement in INSIDE:
        name = pattern.sub(replacement, name)
    return name


def from_published(state: Mapping[str, Tensor]) -> QUIVER:
    """Return the float32 network with the 335 entries of a published state dict, whose shapes determine the width.

    Aliases may be missing, but must equal the block that they repeat. ValueError for anything else: entries that are
    missing, unknown or of another shape, values that are not finite, flow constants that are not the published ones.
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
        if not value.is_floating_point() or not bool(torch.isfinite(value.float()).all()):
            raise ValueError(f"published checkpoint: {theirs} holds values that are not finite numbers")
        ours[name] = value.to(torch.float32, copy=True)
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


def convert_weights(source: Path, target: Path, *, force: bool = False) -> QUIVER:
    """Convert a published checkpoint (.pt, .pth, .ckpt, .safetensors) to our file, and return the network.

    ValueError for any other content, FileExistsError if `target` exists; `force` replaces it, in one step.
    """
    if target.exists() and not force:
        raise FileExistsError(f"{target} exists; choose another name or remove it")
    network = from_published(_read_foreign(source))
    save(network, network.config, target, notes={"converted_from": source.name})
    return network


def _read_foreign(path: Path) -> dict[str, Tensor]:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such checkpoint")
    if path.suffix == ".safetensors":
        state, metadata = read_safetensors(path)
        if metadata.get("format") == FORMAT:
            raise ValueError(f"{path}: holds weights of this program; they need no conversion")
        return {name.removeprefix("module."): value for name, value in state.items()}
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


def _some(names: object, count: int = 3) -> str:
    listed = [str(name) for name in names]  # type: ignore[attr-defined]
    if len(listed) > count:
        listed = [*listed[:count], "..."]
    return ", ".join(listed) or "none"


# ---- Compared networks, whose layers have the published names


def load_published(network: nn.Module, state: Mapping[str, Tensor], unused: tuple[str, ...] = ()) -> list[str]:
    """Load a published state dict of any shape; return the entries that begin with one of `unused` and are not built.

    Buffers that the state lacks keep their constants. ValueError for parameters that are missing, for unknown entries,
    and for shapes that differ.
    """
    own = network.state_dict()
    constants = own.keys() - {name for name, _ in network.named_parameters()}
    left = [name for name in state if name not in own and name.startswith(unused)]
    title = type(network).__name__
    missing = sorted(own.keys() - state.keys() - constants)
    unknown = sorted(state.keys() - own.keys() - set(left))
    if missing or unknown:
        fault = f"{missing[0]} is missing" if missing else f"{unknown[0]} is unknown"
        raise ValueError(f"not a published state of {title}: {fault}; give all entries of the published network")
    for name, value in state.items():
        if name in own and value.shape != own[name].shape:
            raise ValueError(
                f"not a published state of this {title}: {name} is {tuple(value.shape)}, expected "
                f"{tuple(own[name].shape)}; choose the width of the stored weights"
            )
    network.load_state_dict({name: value for name, value in state.items() if name in own}, strict=False)
    return left
