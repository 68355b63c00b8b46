"""MemDeblur equals the published one at every stage, uses the whole clip, and takes any size.

The committed arrays are all of the full file but six:

    python -c "from golden import *; f = SHARED / 'golden_memdeblur.npz'; o = DATA / 'golden_memdeblur.npz', beyond
    cut(f, o, sorted(arrays_of(f).keys() - {'output_full', 'output_half', 'output_quarter', 'backward_last',
    'hidden_full_last', 'output_full_t5_training_memory'}))"
"""

import json
import types
from dataclasses import replace
from pathlib import Path

import golden_memdeblur
import numpy as np
import pytest
import torch
from golden import DATA, arrays_of, beyond, draw, errors, golden_files, weights_by_table

from quiver.model.rivals import memdeblur
from quiver.model.rivals.memdeblur import MemDeblur, MemDeblurConfig

TABLE = DATA / "memdeblur_state_dict.tsv"
TINY = MemDeblurConfig(width=8, forward_blocks=1, backward_blocks=1)


COMMITTED, *FULL = golden_files("memdeblur")


@pytest.mark.parametrize("path", [COMMITTED, *(pytest.param(full, marks=pytest.mark.slow) for full in FULL)], ids=str)
def test_every_stage_equals_the_published_one(path):
    found = errors("memdeblur", arrays_of(path), TABLE)
    assert len(found) >= 17
    assert not beyond(found, arrays_of(path), TABLE)


@pytest.mark.slow
def test_two_clips_of_another_size_equal_the_published_numbers():
    codes = np.random.default_rng(42).integers(0, 8, (2, 7, 1, 64, 48))
    found = golden_memdeblur.stages({"codes": codes}, weights_by_table(TABLE))
    wanted = {
        "output_quarter": (0.4586315252, 0.1714183104, 0.7527541482),
        "output_full": (0.4600016842, 0.3325598881, 0.7841512060),
    }
    for key, numbers in wanted.items():
        array = found[key].detach()
        assert (array.mean(), array.std(correction=0), array.flatten()[-1]) == pytest.approx(numbers, abs=1e-10), key


def test_weights_depend_on_the_prefix_and_few_frames_have_fewer_stages():
    arrays = {"codes": np.random.default_rng(1).integers(0, 8, (2, 1, 1, 20, 12))}
    with torch.no_grad():
        runs = [golden_memdeblur.stages(arrays, weights_by_table(TABLE, prefix)) for prefix in ("", "x.")]
    assert "read_image_full_t1" not in runs[0]
    assert runs[0]["output_quarter"].shape == (2, 1, 3, 8, 4)  # 20/4 = 5 and 12/4 = 3, up to multiples of 4
    assert runs[0]["output_half"].shape == (2, 1, 3, 12, 8)
    assert (runs[0]["output_full"] - runs[1]["output_full"]).abs().max() > 0.01


MISTAKES = {  # what is written, what is written wrongly; each in exactly one place of the module
    "LeakyReLU 0.2": ("SLOPE = 0.1", "SLOPE = 0.2"),
    "no ReLU in the residual block": ("x + self.conv2(F.relu(self.conv1(x)))", "x + self.conv2(self.conv1(x))"),
    "no square term": (" - keys.square().sum(dim=1)[..., None]", ""),
    "not divided by 8": ("nearness / math.sqrt(keys.shape[1])", "nearness"),
    "all entries": ("nearness.shape[1] > NEAREST", "nearness.shape[1] > 10**6"),
    "nothing dropped": ("kept = 0 if self.training else KEPT * new.keys.shape[2]", "kept = 0"),
    "cleared between scales": ("        outputs = []\n", "        outputs = []\n        stored = None\n"),
    "backward memory of training": ("if self.training else i % BACKWARD_EVERY == 2", ""),
    "written at every frame": ("if i % EVERY[scale] == 0", "if True"),
    "value of the input image": ("self.downsampling(outputs[-1])", "self.downsampling(image)"),
    "coarser features too early": ("parts.append(self.downsampling(", "parts.insert(1, self.downsampling("),
    "reads exchanged": ("of_features, of_images =", "of_images, of_features ="),
    "fusion the other way": (
        "join(resize(behind[i], *feature.shape[-2:]), hidden)",
        "join(hidden, resize(behind[i], *feature.shape[-2:]))",
    ),
    "sizes rounded down": ("-(side // divisor) // MULTIPLE * -MULTIPLE", "side // divisor // MULTIPLE * MULTIPLE"),
    "no bilinear skip": (" + resize(y, 4 * y.shape[-2], 4 * y.shape[-1])", ""),
    "eps 1e-3": ("nn.BatchNorm2d(channels)", "nn.BatchNorm2d(channels, eps=1e-3)"),
    "decoder of images for features": ("return self.decoder_feat(values)", "return self.decoder_mem(values)"),
    "values image first": ("join(feature_value, image_value)", "join(image_value, feature_value)"),
}


@pytest.mark.slow
@pytest.mark.parametrize("mistake", MISTAKES)
def test_each_mistake_is_seen(mistake, monkeypatch):
    right, wrong = MISTAKES[mistake]
    source = Path(memdeblur.__file__).read_text(encoding="utf-8")
    assert source.count(right) == 1
    module = types.ModuleType("mistaken")
    exec(source.replace(right, wrong), module.__dict__)
    monkeypatch.setattr(golden_memdeblur, "MemDeblur", module.MemDeblur)
    found = errors("memdeblur", arrays_of(DATA / "golden_memdeblur.npz"), TABLE)
    assert max(1.0 if error is None else error for error in found.values()) > 1e-3, found


def test_the_published_network_has_the_published_parameters():
    network = MemDeblur(MemDeblurConfig(group_norm=False, as_published=True))
    parts = {
        "downsampling": 48_420,
        "upsampling": 24_291,
        "forward_input_convs": 663_744,
        "forward_resblocks": 2_215_680,
        "backward_resblocks": 867_648,
        "fusion": 8_256,
        "memory": 3_161_008,
        "memory.key_encoder": 471_856,
        "memory.key_proj": 147_520,
        "memory.decoder_feat": 886_080,
    }
    for name, count in parts.items():
        assert sum(parameter.numel() for parameter in network.get_submodule(name).parameters()) == count, name
    assert sum(parameter.numel() for parameter in network.parameters()) == 7_027_706 - 38_659
    names = [line.split("\t")[0] for line in TABLE.read_text().splitlines()[1:]]
    assert list(network.state_dict()) == [name for name in names if not name.startswith(network.unused)]


def test_every_frame_sees_the_whole_clip():
    network = golden_memdeblur.small()
    frames = draw(1, 7, 1, 16, 12)
    with torch.no_grad():
        exact = network(frames)
        for t in (0, 3, 6):
            changed = frames.clone()
            changed[:, t] = 1 - changed[:, t]
            assert (network(changed) - exact).abs().amax((0, 2, 3, 4)).min() > 1e-9


def test_the_input_is_centred_but_for_the_published_form():
    ours = MemDeblur(TINY).eval()
    published = MemDeblur(MemDeblurConfig(8, 1, 1, as_published=True)).eval()
    published.load_state_dict(ours.state_dict())
    frames = draw(1, 2, 1, 16, 16, dtype=torch.float32)
    with torch.no_grad():
        assert torch.allclose(ours(frames) - 0.5, published(frames - 0.5), atol=1e-5)
        assert not torch.allclose(ours(frames), published(frames), atol=1e-5)


def test_many_frames_and_both_memories_of_a_long_clip():
    network = golden_memdeblur.small()
    frames = draw(1, 14, 1, 32, 20)
    golden_memdeblur.remember_as_in_training(network)
    with torch.no_grad():
        training = network(frames)
        evaluation = network.eval()(frames)
    assert training.isfinite().all()
    assert (training - evaluation).abs().max() > 1e-9


@pytest.mark.parametrize(("group_norm", "batch"), [(True, 1), (False, 2)])
def test_every_parameter_learns(group_norm, batch):
    network = MemDeblur(MemDeblurConfig(width=8, forward_blocks=1, backward_blocks=1, group_norm=group_norm)).train()
    images = network.images(draw(batch, 3, 1, 32, 32, dtype=torch.float32))
    sum(output.square().mean() for output in network.scales(images)).backward()
    assert not [name for name, p in network.named_parameters() if p.grad is None or not p.grad.isfinite().all()]
    blocks = ("forward_resblocks.main.0.0.conv1.weight", "memory.value_encoder_feat.conv1.weight", "fusion.weight")
    assert all(network.get_parameter(name).grad.abs().max() > 0 for name in blocks)


def test_batch_normalisation_refuses_a_single_value():
    network = MemDeblur(replace(TINY, group_norm=False)).train()
    with pytest.raises(ValueError, match="a batch of one clip of 64 x 32 px leaves batch normalisation one value"):
        network(draw(1, 2, 1, 64, 32, dtype=torch.float32))
    assert network(draw(1, 2, 1, 68, 4, dtype=torch.float32)).isfinite().all()


def test_training_and_evaluation_agree_while_memories_are_small():
    """Up to 20 entries both modes read all; batch normalisation, as published, changes between them."""
    frames = draw(1, 2, 1, 96, 32, dtype=torch.float32)
    for group_norm in (True, False):
        torch.manual_seed(0)
        network = MemDeblur(replace(TINY, group_norm=group_norm))
        with torch.no_grad():
            same = torch.equal(network.train()(frames), network.eval()(frames))
        assert same == group_norm


def test_half_precision_is_close():
    network = MemDeblur(MemDeblurConfig(width=16, forward_blocks=4, backward_blocks=2)).eval()
    frames = draw(1, 3, 1, 24, 32, dtype=torch.float32)
    with torch.no_grad():
        exact = network(frames)
        with torch.autocast("cpu", torch.bfloat16):
            close = network(frames)
    assert float((close.float() - exact).square().mean().sqrt() / exact.std()) < 0.02


def test_a_configuration_survives_json():
    config = MemDeblurConfig(width=24, group_norm=False, as_published=True)
    assert MemDeblurConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("width", 0, "MemDeblurConfig.width must be a whole number from 8"),
        ("width", 12, "MemDeblurConfig.width must be a multiple of 8, got 12"),
        ("forward_blocks", -1, "MemDeblurConfig.forward_blocks must be a whole number from 0"),
        ("group_norm", "yes", "MemDeblurConfig.group_norm must be true or false, got 'yes'"),
        ("as_published", 1, "MemDeblurConfig.as_published must be true or false"),
    ],
)
def test_configurations_out_of_range_are_refused(field, value, message):
    with pytest.raises(ValueError, match=message):
        MemDeblurConfig(**{field: value})
