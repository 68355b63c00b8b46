"""Tests the counter of multiply-accumulates against hand counts, and the networks that are to cost alike."""

import pytest
import torch
from runs import EVERY, tiny
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils.flop_counter import FlopCounterMode

from quiver.evaluation.macs import MacCounter, design_macs, macs, macs_per_pixel
from quiver.model.mergenet import MergeNetConfig
from quiver.model.names import COMPARED, EQUAL_COST
from quiver.model.presets import PRESETS, made
from quiver.model.rivals.edges import pad_space
from quiver.model.rivals.emvd import EMVDConfig
from quiver.model.rivals.fastdvdnet import FastDVDnet, FastDVDnetConfig
from quiver.model.rivals.rvrt import RVRTConfig
from quiver.model.rivals.student_teacher import StudentTeacher, StudentTeacherConfig
from quiver.model.unet import UNetConfig


class Layers(nn.Module):
    """One layer of each kind that the networks have, on every frame."""

    def __init__(self) -> None:
        super().__init__()
        self.enter = nn.Conv2d(1, 6, 3, padding=1)  # 54 per pixel
        self.grouped = nn.Conv2d(6, 8, 3, stride=2, padding=1, groups=2)  # 8 * 3 * 9 = 216 per pixel of half size
        self.linear = nn.Linear(8, 5)  # 40
        self.up = nn.ConvTranspose2d(8, 3, 2, stride=2)  # 8 * 3 * 4 = 96
        self.volume = nn.Conv3d(3, 2, 3, padding=1)  # 162 per pixel of full size

    def forward(self, frames: Tensor) -> Tensor:
        x = self.grouped(self.enter(frames.flatten(0, 1)))
        self.linear(x.movedim(1, -1))
        flat = x.flatten(2)
        flat @ flat.mT  # 8 * 8 per pixel of half size
        return self.volume(self.up(x).movedim(0, 1))


def test_layers_cost_what_they_cost_by_hand():
    quarter = 216 + 40 + 96 + 64
    assert macs(Layers(), 3, 8, 12) == 3 * 8 * 12 * (54 + 162) + 3 * 4 * 6 * quarter
    assert macs_per_pixel(Layers(), (2, 4), 8) == 54 + 162 + quarter / 4


def test_a_network_costs_what_its_layers_cost():
    """By hand from the tables of layers: of a block of FastDVDnet, and of a student."""
    w = 4
    each = 3
    full = 9 * (3 * 2 * each + 3 * each * w + w * w + w)
    half = 9 * (w * 2 * w + 2 * (2 * w) ** 2 + 2 * (2 * w) ** 2 + 2 * w * 4 * w)
    quarter = 9 * (2 * w * 4 * w + 4 * (4 * w) ** 2 + 4 * w * 8 * w)
    network = FastDVDnet(FastDVDnetConfig(width=w)).eval()
    assert macs_per_pixel(network, (2, 4), 16) == 2 * (full + half / 4 + quarter / 16)
    w = 3
    full = 9 * (2 * (11 * w + 2 * w * w) + 3 * w * w + 2 * w * w + w)
    half = 9 * (2 * (w * w + 2 * w * w) + 2 * w * w + 2 * w * w + w * 4 * w)
    student = StudentTeacher(StudentTeacherConfig(width=w, blocks=1)).eval()
    assert macs_per_pixel(student, (1, 2), 8) == full + half / 4


def test_published_sizes_cost_what_is_published():
    """GMAC per frame at 256 x 256 of the specification; only convolutions, so pixels of any size cost alike."""
    pixels = 256**2
    assert macs_per_pixel(FastDVDnet().eval(), (1, 2), 16) * pixels == pytest.approx(20.6e9, rel=0.003)
    assert macs_per_pixel(StudentTeacher().eval(), (1, 2), 16) * pixels == pytest.approx(85.4e9, rel=0.001)


class Extended(nn.Conv2d):
    """A layer of 9 per pixel that extends small frames, as RVRT does."""

    least = 12  # px

    def forward(self, frames: Tensor) -> Tensor:
        return super().forward(pad_space(frames, 1, self.least).flatten(0, 1))


def test_frames_that_a_network_would_extend_are_not_counted():
    assert macs_per_pixel(Extended(1, 1, 3, padding=1), (2, 4), 8) == 9


@pytest.mark.slow
def test_rvrt_costs_what_its_layers_cost():
    """Added up from the layers; of frames of 128 px, which it extends to 132 px, 981 143 were counted."""
    assert design_macs(RVRTConfig()) == pytest.approx(744_091, rel=1e-3)


SLOW = ("memdeblur-1m", "rvrt-1m", "spk2imgnet-1m", "flornn-1m", "emvd-1m", "quiver-s-1m")  # three to twelve seconds


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in EQUAL_COST]
)
def test_networks_of_equal_cost_cost_a_million(name):
    assert 0.9e6 < design_macs(PRESETS[name]) < 1.1e6


@pytest.mark.parametrize("config", [UNetConfig(2), EMVDConfig(width=2), MergeNetConfig(width=3)])
def test_nothing_needs_to_be_computed_for_a_count(config):
    """Of shapes alone, as of values, at the sizes that the counter takes."""
    small = macs_per_pixel(made(config).eval(), (3, 4), 16)
    with FakeTensorMode():
        assert macs_per_pixel(made(config).eval(), (3, 4), 16) == small > 0


@pytest.mark.slow
@pytest.mark.parametrize("name", EVERY)
def test_torch_counts_the_same(name):
    """Of any network, with and without derivatives, whose operations torch takes apart in different places."""
    network = tiny(name).eval()
    frames = torch.zeros((1, network.config.inputs, 16, 24) if name == "mergenet" else (1, 12, 1, 16, 24))
    for without in (torch.no_grad, torch.inference_mode):
        with without(), FlopCounterMode(display=False) as theirs:
            network(frames)
        with without(), MacCounter() as ours:
            network(frames)
        assert ours.total * 2 == theirs.get_total_flops() > 0


def test_every_compared_network_has_a_size_of_equal_cost():
    assert set(EQUAL_COST) == {f"{name}-1m" for name in (*COMPARED, "quiver-s", "mergenet")}
