"""Spk2ImgNet equals the published one at every stage, has the factor that its port forgot, and takes any clip.

The committed arrays are those of the full file in which every mistake below shows:

    python -c "from golden import *; f = SHARED / 'golden_spk2imgnet.npz'; o = DATA / 'golden_spk2imgnet.npz', beyond
    cut(f, o, ['codes', 'output', 'features_group0', 'offset_mask3_nb0', 'dcn3_nb0', 'dcn2_nb0', 'aligned0'])"
"""

import json
import types
from pathlib import Path

import golden_spk2imgnet
import numpy as np
import pytest
import torch
from golden import DATA, arrays_of, beyond, draw, errors, fill_by_rule, golden_files, weights_by_table

from quiver.model.rivals import spk2imgnet
from quiver.model.rivals.edges import reflected
from quiver.model.rivals.spk2imgnet import Spk2ImgNet, Spk2ImgNetConfig

TABLE = DATA / "spk2imgnet_state_dict.tsv"


def codes(*shape: int) -> dict[str, np.ndarray]:
    return {"codes": np.random.default_rng(5).integers(0, 8, shape)}


def test_every_stage_equals_the_published_one():
    committed, *full = (arrays_of(path) for path in golden_files("spk2imgnet"))
    arrays = {**committed, **(full[0] if full else {})}
    assert all(np.array_equal(array, arrays[key]) for key, array in committed.items())
    found = errors("spk2imgnet", arrays, TABLE)
    assert len(found) == (16 if full else 6)
    assert not beyond(found, arrays, TABLE)


def test_two_windows_of_another_size_equal_the_published_numbers():
    codes = np.random.default_rng(32).integers(0, 8, (2, 10, 20, 36))
    found = golden_spk2imgnet.stages({"codes": codes}, weights_by_table(TABLE))
    wanted = {
        "output": (0.0255789003, 0.0415459985, 0.0401262717),
        "estimates": (-0.1278755178, 0.3001407764, 0.1372021017),  # of group 4
    }
    for key, array in (("output", found["output"].detach()), ("estimates", found["estimates"][:, 4].detach())):
        ours = (array.mean(), array.std(correction=0), array.flatten()[-1])
        assert ours == pytest.approx(wanted[key], abs=1e-10), key


def test_stages_of_other_widths_batches_and_sizes():
    weights = golden_spk2imgnet.small().state_dict()
    large = golden_spk2imgnet.stages(codes(3, 10, 12, 16), weights)
    alone = golden_spk2imgnet.stages({"codes": codes(3, 10, 12, 16)["codes"][1:2]}, weights)
    for key, array in large.items():
        assert torch.allclose(array[1:2], alone[key], rtol=0, atol=1e-12), key


def test_weights_depend_on_the_prefix():
    plain, other = (weights_by_table(TABLE, prefix)["rec_conv2.weight"] for prefix in ("", "x."))
    assert (plain - other).abs().max() > 0.01


MISTAKES = {  # what is written, what is written wrongly; each exactly once in the module
    "estimates not weighted": ('self["ca"](estimates) * estimates', 'self["ca"](estimates)'),
    "no global skip": ('self["net"](shallow) + shallow', 'self["net"](shallow)'),
    "block without last ReLU": ("return F.relu(x + self.conv3(", "return (x + self.conv3("),
    "slope 0.2": ("F.leaky_relu(x, 0.1)", "F.leaky_relu(x, 0.2)"),
    "order of neighbour and middle": ("torch.cat([neighbour, middle], dim=1)", "torch.cat([middle, neighbour], dim=1)"),
    "shifts not doubled": ("2 * _doubled(coarser)", "_doubled(coarser)"),
    "corners aligned": ("align_corners=False", "align_corners=True"),
    "offsets (x, y)": (
        "deform_conv2d(features, offset,",
        "deform_conv2d(features, offset.unflatten(1, (-1, 2)).flip(2).flatten(1, 2),",
    ),
    "offsets by kind": (
        "deform_conv2d(features, offset,",
        "deform_conv2d(features, offset.unflatten(1, (2, -1)).transpose(1, 2).flatten(1, 2),",
    ),
    "activation at the finest level": ("if level == 2:", "if level:"),
    "activation after the moved features": (
        'self[f"L{level}_dcnpack_1"](features, motion)',
        '_leaky(self[f"L{level}_dcnpack_1"](features, motion))',
    ),
    "cascade on the neighbour": ('self["cas_dcnpack"](aligned, motion)', 'self["cas_dcnpack"](neighbour[0], motion)'),
    "order of the gate": ("torch.cat([aligned, middle], dim=1)", "torch.cat([middle, aligned], dim=1)"),
    "ReLU in the gate": ("self.prelu1(self.conv1(x))", "F.relu(self.conv1(x))"),
    "gate of another group": (
        "self.mask0, self.mask1, None, self.mask3, self.mask4)",
        "self.mask1, self.mask0, None, self.mask3, self.mask4)",
    ),
    "input frame added": ("return restored / self.unit,", "return (restored + frames[:, 5:6]) / self.unit,"),
}


def liveliest(module: types.ModuleType = spk2imgnet):
    """A narrow network of a module, in which offsets are several pixels."""
    network = fill_by_rule(module.Spk2ImgNet(module.Spk2ImgNetConfig(width=8, blocks=1))).double().eval()
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            parameter *= 8 if "offset_mask" in name else 2
    return network


@pytest.mark.parametrize("mistake", MISTAKES)
def test_each_mistake_is_seen(mistake):
    right, wrong = MISTAKES[mistake]
    source = Path(spk2imgnet.__file__).read_text(encoding="utf-8")
    assert source.count(right) == 1
    module = types.ModuleType("mistaken")
    exec(source.replace(right, wrong), module.__dict__)
    frames = draw(1, 10, 20, 24)
    with torch.no_grad():
        found = liveliest(module).window(frames)[0]
        wanted = liveliest().window(frames)[0]
    assert (found - wanted).abs().max() > 0.1 * wanted.std()


def test_the_published_network_has_the_published_parameters():
    network = Spk2ImgNet()
    parts = {
        "extractor": 1_112_592,
        "pcd_align": 1_532_000,
        "rec_conv0": 553_152,
        "rec_conv1": 110_656,
        "rec_conv2": 577,
    } | {f"mask{group}": 147_650 for group in (0, 1, 3, 4)}
    for name, count in parts.items():
        assert sum(parameter.numel() for parameter in getattr(network, name).parameters()) == count
    assert sum(parameter.numel() for parameter in network.parameters()) == sum(parts.values()) == 3_899_577
    names = [line.split("\t")[0] for line in TABLE.read_text().splitlines()[1:]]
    assert list(network.state_dict()) == names


def test_deformable_convolutions_begin_without_offsets():
    layer = Spk2ImgNet(Spk2ImgNetConfig(width=8)).pcd_align["pcd_align"]["cas_dcnpack"]
    features = draw(1, 8, 7, 9, dtype=torch.float32)
    plain = torch.nn.functional.conv2d(features, layer.weight, padding=1) / 2
    assert torch.allclose(layer(features, features), plain, atol=1e-6)


@pytest.mark.parametrize("group_frames", [2, 3])
def test_every_frame_of_a_clip_is_that_of_its_window(group_frames):
    config = Spk2ImgNetConfig(width=8, blocks=1, group_frames=group_frames)
    network = fill_by_rule(Spk2ImgNet(config)).double()
    frames = draw(1, 12, 1, 8, 12)
    with torch.no_grad():
        restored = network(frames)
        for t in range(12):
            window = frames[:, reflected(t - 5, network.frames_in, 12), 0]
            assert (network.window(window)[0] - restored[:, t]).abs().max() < 1e-12
    assert (network.frames_in, network.look_ahead) == {2: (10, 4), 3: (11, 5)}[group_frames]


def test_groups_of_three_reach_equally_far_into_past_and_future():
    network = fill_by_rule(Spk2ImgNet(Spk2ImgNetConfig(width=8, blocks=1, group_frames=3))).double()
    frames = draw(1, 15, 1, 8, 8)
    changed = frames.clone()
    changed[:, [1, 13]] = 1 - changed[:, [1, 13]]
    with torch.no_grad():
        differences = (network(frames) - network(changed))[:, 7]
    assert differences.abs().max() == 0  # frames 2 ... 12 alone restore frame 7


def test_the_factor_of_the_port_is_missing_only_as_published():
    mended = golden_spk2imgnet.small()
    port = Spk2ImgNet(Spk2ImgNetConfig(width=8, blocks=1, as_published=True))
    port.double().load_state_dict(mended.state_dict())
    frames = draw(1, 2, 1, 8, 8)
    with torch.no_grad():
        assert torch.allclose(mended(frames) * 0.6, port(frames), rtol=1e-12)
        for ours, published in zip(mended.window(draw(1, 10, 8, 8)), port.window(draw(1, 10, 8, 8)), strict=True):
            assert torch.allclose(ours * 0.6, published, rtol=1e-12)


def test_half_precision_is_close():
    network = fill_by_rule(Spk2ImgNet(Spk2ImgNetConfig(width=16, blocks=2))).eval()
    frames = draw(1, 2, 1, 24, 32, dtype=torch.float32)
    with torch.no_grad():
        exact = network(frames)
        with torch.autocast("cpu", torch.bfloat16):
            close = network(frames)
    assert float((close.float() - exact).square().mean().sqrt() / exact.std()) < 0.05


def test_every_parameter_learns():
    network = golden_spk2imgnet.small()
    network.window(draw(1, 10, 16, 16))[0].square().mean().backward()
    assert not [name for name, p in network.named_parameters() if p.grad is None or not p.grad.isfinite().all()]
    assert not [name for name, p in network.named_parameters() if p.grad.abs().max() == 0]


def test_a_configuration_survives_json():
    config = Spk2ImgNetConfig(width=24, blocks=3, as_published=True)
    assert Spk2ImgNetConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"width": 0}, "Spk2ImgNetConfig.width must be a whole number from 8"),
        ({"width": 12}, "Spk2ImgNetConfig.width must be a multiple of 8, got 12"),
        ({"blocks": 0}, "Spk2ImgNetConfig.blocks must be a whole number from 1"),
        ({"group_frames": 4}, "Spk2ImgNetConfig.group_frames must be a whole number from 2 to 3"),
        ({"as_published": 1}, "Spk2ImgNetConfig.as_published must be true or false"),
        ({"as_published": True, "group_frames": 3}, "Spk2ImgNetConfig.as_published needs groups of 2 frames, got 3"),
    ],
)
def test_configurations_out_of_range_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        Spk2ImgNetConfig(**values)
