"""Tests the 335 published entries, their conversion, and the refusal of everything else."""

import pickle
from pathlib import Path

import pytest
import torch
from golden import published_state
from safetensors import safe_open
from safetensors.torch import save_file

from quiver.model.presets import PRESETS
from quiver.model.published_weights import ALIAS, convert_weights, from_published, published_name
from quiver.model.quiver import QUIVER
from quiver.model.weights import load


def notes(path: Path) -> dict[str, str]:
    with safe_open(path, framework="pt") as file:
        return file.metadata()


@pytest.fixture(scope="module")
def state() -> dict[str, torch.Tensor]:
    return published_state()


def test_every_published_entry_has_one_place_and_nothing_is_left(state):
    network = QUIVER(PRESETS["quiver-s"])
    names = [published_name(name) for name in network.state_dict()]
    aliases = [name for name in state if ALIAS.match(name)]
    assert len(state) == 335
    assert len(set(names)) == len(names) == 303  # 301 parameters and 2 buffers
    assert sorted(names + aliases) == sorted(state)
    assert len(list(network.parameters())) == 301
    assert len(aliases) == 32


def test_published_weights_arrive_where_their_names_say(state):
    network = from_published(state)
    for name, value in network.state_dict().items():
        assert torch.equal(value, state[published_name(name)]), name
    assert network.config == PRESETS["quiver-s"]
    assert all(parameter.requires_grad for parameter in network.parameters())


def test_aliases_may_be_absent_but_not_different(state):
    from_published({name: value for name, value in state.items() if not ALIAS.match(name)})
    name = "predenoise.rdbs.3.conv1x1.bias"
    with pytest.raises(ValueError, match=r"predenoise.rdbs.3.conv1x1.bias differs from predenoise.rdbs.0.conv1x1.bias"):
        from_published(state | {name: state[name] + 1})


def without(state: dict, name: str) -> dict:
    return {key: value for key, value in state.items() if key != name}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: {}, "not a published QUIVER checkpoint: predenoise.sfe1.weight.*missing; found 0 entries"),
        (lambda s: {"a": torch.ones(1)}, "is missing; found 1 entries: a"),
        (lambda s: without(s, "recons3.out.7.bias"), "1 entries are missing, among them recons3.out.7.bias"),
        (lambda s: s | {"head.weight": torch.ones(1)}, "1 entries are unknown, among them head.weight"),
        (lambda s: s | {"predenoise.rdbs.1.extra": torch.ones(1)}, "unknown, among them predenoise.rdbs.1.extra"),
        (lambda s: s | {"epoch": 3}, "epoch is a int, not a tensor"),
        (lambda s: s | {"pa_deform.bias": torch.ones(17)}, r"pa_deform.bias must be \(16,\) at width 16, got \(17,\)"),
        (lambda s: s | {"pa_deform.bias": torch.full((16,), torch.nan)}, "pa_deform.bias holds values that are not"),
        (
            lambda s: s | {"pa_deform.bias": torch.full((16,), 1e300, dtype=torch.float64)},  # infinite as float32
            "pa_deform.bias holds values that are not",
        ),
        (lambda s: s | {"spynet.std": torch.ones(1, 1, 1, 1)}, "spynet.std must be 0.226, got 1.0"),
    ],
)
def test_anything_else_is_refused_by_name(state, change, message):
    with pytest.raises(ValueError, match=message):
        from_published(change(state))


@pytest.mark.parametrize("wrap", [lambda s: s, lambda s: {"epoch": 7, "state_dict": s}], ids=["bare", "nested"])
@pytest.mark.parametrize("prefix", ["", "module."])
def test_a_checkpoint_is_converted(tmp_path: Path, state, wrap, prefix):
    source = tmp_path / "their.pth"
    target = tmp_path / "ours.safetensors"
    torch.save(wrap({prefix + name: value for name, value in state.items()}), source)
    convert_weights(source, target)
    ours = load(target)
    assert ours.config == PRESETS["quiver-s"]
    assert torch.equal(ours.alignment.weight, state["pa_deform.weight"])
    assert notes(target)["converted_from"] == "their.pth"
    with pytest.raises(FileExistsError, match=r"ours\.safetensors exists"):
        convert_weights(source, target)


def test_the_prefix_of_several_devices_is_removed_from_any_kind_of_file(tmp_path: Path, state):
    source = tmp_path / "their.safetensors"
    target = tmp_path / "ours.safetensors"
    save_file({f"module.{name}": value for name, value in state.items() if not ALIAS.match(name)}, source)
    convert_weights(source, target)
    assert torch.equal(load(target).alignment.weight, state["pa_deform.weight"])


def test_a_checkpoint_in_float64_becomes_float32(tmp_path: Path, state):
    source = tmp_path / "their.pth"
    target = tmp_path / "ours.safetensors"
    torch.save({name: value.double() for name, value in state.items()}, source)
    convert_weights(source, target)
    ours = load(target).state_dict()
    for name, value in from_published(state).state_dict().items():
        assert torch.equal(ours[name], value), name


class Bomb:
    """An object whose pickle writes a file when it is loaded."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return (Path.touch, (self.path,))


def test_pickled_programs_are_never_run(tmp_path: Path):
    trace = tmp_path / "executed"
    for number, write in enumerate((torch.save, lambda value, path: path.write_bytes(pickle.dumps(value)))):
        source = tmp_path / f"{number}.pth"
        write({"state_dict": Bomb(trace)}, source)
        with pytest.raises(ValueError, match="pickled programs are never run"):
            convert_weights(source, tmp_path / "ours.safetensors")
    assert not trace.exists()
    assert not (tmp_path / "ours.safetensors").exists()


@pytest.mark.parametrize("content", [b"", b"not weights at all", b"PK\x03\x04 broken"])
@pytest.mark.parametrize("name", ["x.pth", "x.safetensors"])
def test_damaged_files_are_named(tmp_path: Path, content, name):
    source = tmp_path / name
    source.write_bytes(content)
    with pytest.raises(ValueError, match=name):
        convert_weights(source, tmp_path / "ours.safetensors")
    with pytest.raises(FileNotFoundError, match=r"absent\.pth"):
        convert_weights(tmp_path / "absent.pth", tmp_path / "ours.safetensors")


def test_a_checkpoint_that_is_a_list_is_refused(tmp_path: Path):
    torch.save([torch.ones(2)], tmp_path / "list.pth")
    with pytest.raises(ValueError, match="expected a dictionary of named tensors, found list"):
        convert_weights(tmp_path / "list.pth", tmp_path / "ours.safetensors")
