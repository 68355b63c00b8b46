"""Writes and reads weights as safetensors files.

No pickled code is executed: our files are safetensors, and torch reads other checkpoints with `weights_only=True`.
"""

import hashlib
import json
import pickle
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as to_safetensors
from torch import Tensor, nn

from qsim import limits, opening
from qsim.files import write_bytes
from qsim.thread_warnings import warnings_here
from quiver.host import own_numbers
from quiver.model.presets import WithoutValues, configuration, made

FORMAT = "quiver-1"  # value of the metadata key "format" in our files
MAX_REASON = 300  # characters of an error of torch that are shown
DAMAGE = (  # errors that torch raises for damaged files and other content
    *(RuntimeError, EOFError, LookupError, ValueError, TypeError, AttributeError, OverflowError, MemoryError),
    *(RecursionError, pickle.UnpicklingError, zipfile.BadZipFile, NotImplementedError, AssertionError),
)


def read_torch(path: Path, device: torch.device | str = "cpu") -> Any:
    """Return the tensors and plain values of a torch file; ValueError with a short reason for any other file.

    Nothing in the file is executed. A zip whose parts claim more bytes than the file has is refused before it is
    read, because torch does not compress.
    """
    opening.regular(path, "checkpoint", most=limits.WEIGHTS)
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                told = sum(part.file_size for part in archive.infolist())
            if told > path.stat().st_size:
                raise ValueError(f"parts of {told} bytes in a file of {path.stat().st_size}")
        with warnings_here("ignore"):  # about pickle dialects, which end in the error below
            return torch.load(path, map_location=device, weights_only=True)
    except pickle.UnpicklingError:  # torch advises to trust the file, with escapes of the terminal
        raise ValueError("it holds pickled objects beside tensors and plain values") from None
    except DAMAGE as error:
        raise ValueError(short_reason(error)) from None


def short_reason(error: BaseException) -> str:
    """Return the first line of an error of torch, at most MAX_REASON characters."""
    lines = str(error).strip().splitlines()
    return lines[0][:MAX_REASON] if lines else type(error).__name__


def save(network: nn.Module, config: Any, path: Path, notes: Mapping[str, str] | None = None) -> None:
    """Write the weights and the configuration of a network as safetensors, atomically; `notes` become metadata."""
    if path.suffix != ".safetensors":
        raise ValueError(f"weights are written as .safetensors, got {path.name}")
    metadata = {
        **(notes or {}),
        "format": FORMAT,
        "network": type(network).__name__,
        "config": json.dumps(config.to_dict()),
    }
    tensors = {name: value.detach().cpu().contiguous() for name, value in network.state_dict().items()}
    write_bytes(path, _in_bytes(tensors, metadata))


@own_numbers
def load(path: Path) -> nn.Module:
    """Return the network stored by `save`, on the CPU, in evaluation mode; ValueError for any other file.

    Layers are made without memory, from a configuration whose numbers are bounded. A file therefore costs about as much
    memory as its size.
    """
    tensors, metadata = read_safetensors(path)
    if metadata.get("format") != FORMAT:
        raise ValueError(f"{path}: not weights of this program (no format {FORMAT!r}); see `quiver convert-weights`")
    try:
        if len(metadata["config"]) > limits.CONFIGURATION:
            raise ValueError(f"a configuration of {len(metadata['config'])} characters")
        values = json.loads(metadata["config"])
        with torch.device("meta"), WithoutValues():
            network = made(configuration(metadata["network"], values))
        for name, value in network.state_dict().items():
            if name in tensors and tensors[name].dtype == torch.float16 and value.dtype == torch.float32:
                tensors[name] = tensors[name].float()  # of a file that was made smaller by `halved`
            if name in tensors and tensors[name].dtype != value.dtype:
                raise ValueError(f"{name} holds {tensors[name].dtype}, the network {value.dtype}")
        network.load_state_dict(tensors, assign=True)
    except DAMAGE as error:
        reason = " ".join(str(error).split())[:MAX_REASON]
        raise ValueError(f"{path}: weights and configuration do not fit ({reason})") from None
    return network.requires_grad_(True).eval()


def halved(path: Path) -> bytes:
    """Return a weights file of ours with float16 for float32: half of its size, from which `load` makes float32."""
    tensors, metadata = read_safetensors(path)
    small = {name: value.half() if value.dtype == torch.float32 else value for name, value in tensors.items()}
    return _in_bytes(small, metadata)


def metadata_of(path: Path) -> dict[str, str]:
    """Return the notes of a safetensors file; FileNotFoundError or ValueError for any other file."""
    return read_safetensors(path)[1]


def digest(path: Path) -> str:
    """Return the SHA-256 of what decides results: format, network, configuration and tensors; errors as `metadata_of`.

    Other notes, such as measured cells, do not count.
    """
    tensors, metadata = read_safetensors(path)
    about = [metadata.get(key) for key in ("format", "network", "config")]
    kinds = [[name, str(value.dtype), list(value.shape)] for name, value in sorted(tensors.items())]
    found = hashlib.sha256(json.dumps([about, kinds]).encode())
    for name in sorted(tensors):
        found.update(tensors[name].reshape(-1).view(torch.uint8).numpy().data)
    return found.hexdigest()


def annotate(path: Path, notes: Mapping[str, str | None]) -> None:
    """Add notes to a weights file of ours, or remove those that are None; its tensors do not change."""
    tensors, metadata = read_safetensors(path)
    if metadata.get("format") != FORMAT:
        raise ValueError(f"{path}: not weights of this program (no format {FORMAT!r}); see `quiver convert-weights`")
    kept = {name: text for name, text in (metadata | dict(notes)).items() if text is not None}
    write_bytes(path, _in_bytes(tensors, kept))


def _in_bytes(tensors: dict[str, Tensor], metadata: dict[str, str]) -> bytes:
    """Return a safetensors file, equal for equal contents: the library orders notes differently in each process."""
    content = to_safetensors(tensors, metadata)
    end = 8 + int.from_bytes(content[:8], "little")
    header = json.dumps(json.loads(content[8:end]), sort_keys=True, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 8)  # tensors begin at a multiple of eight bytes
    return len(header).to_bytes(8, "little") + header + content[end:]


def read_safetensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Return tensors of any shape and metadata; FileNotFoundError or ValueError for any other file."""
    opening.regular(path, "weights file", most=limits.WEIGHTS)
    try:
        with safe_open(path, framework="pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, dict(file.metadata() or {})  # noqa: SIM118
    except SafetensorError as error:
        raise ValueError(f"{path}: not a safetensors file ({error})") from None
