"""Restores a video frame by frame, by three schedules that share more or less work between windows.

All of them need memory that does not grow with the clip.

* `windows`: every window is computed from its eleven frames alone, as published; for any network.
* `exact`: the same numbers. Pre-denoised frames and flows are computed once. So are the fused features and R1, R2 of
  the frames at window positions 3 to 8, where the 5-frame extractors do not reach beyond the window. At positions 0, 1,
  2, 9, 10 they reach zeros beyond it, so each window computes these itself. The recurrent state starts at zero in each
  window.
* `stream`: one pass over the clip. The state is kept, and each frame is encoded once. The numbers differ, because zeros
  beyond the window and the zero state then occur only at the ends of the clip.
"""

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from quiver.model.blocks import NEIGHBOURS, RADIUS, WINDOW, resize
from quiver.model.quiver import QUIVER, Encoded

REACH = NEIGHBOURS // 2  # frames before and after that an extractor takes


@dataclass(frozen=True)
class Frame:
    """Results of one frame that do not depend on its position in a window, each [B, 1 or 2, h, w]."""

    images: tuple[Tensor, ...]  # at scales 1, 2, 4
    denoised: Tensor
    flows: tuple[Tensor, ...] | None  # into the frame before, at scales 1, 2, 4; None for the first frame of a clip


@dataclass(frozen=True)
class Features:
    """Features [B, C, h/s, w/s] of a frame at scales s = 1, 2, 4; they depend on the frames around it."""

    noisy: tuple[Tensor, ...]
    denoised: tuple[Tensor, ...]


def stream(network: QUIVER, frames: Iterable[Tensor]) -> Iterator[Tensor]:
    """Yield restored frames 5 .. T-6 of frames [B, 1, H, W], each after seven more frames, in one pass."""
    places: deque[Frame | None] = deque([None] * REACH, maxlen=NEIGHBOURS)  # frames around the encoded one
    r4: deque[Tensor] = deque(maxlen=WINDOW)
    finest: deque[tuple[Tensor, Tensor]] = deque(maxlen=RADIUS + 1)
    before: Features | None = None
    for frame in _then_nothing(_prepare(network, frames)):
        places.append(frame)
        current = places[REACH] if len(places) == NEIGHBOURS else None
        if current is None:
            continue
        features = _extract(network, places)
        r1, r2, entry = _encode(network, current, before, features)
        state = network.cell.state(r4[-1]) if r4 else network.first_state(entry)
        before = features
        r4.append(network.cell.step(entry, state))
        finest.append((r1, r2))
        if len(r4) == WINDOW:
            yield network.restore(list(r4), *finest[0])[0]


def exact(network: QUIVER, frames: Iterable[Tensor]) -> Iterator[Tensor]:
    """Yield restored frames 5 .. T-6 of frames [B, 1, H, W], equal to those of `windows`."""
    window: deque[Frame] = deque(maxlen=WINDOW)
    inside: deque[Features] = deque(maxlen=WINDOW - 2 * REACH)  # of positions 2 .. 8
    entries: deque[Tensor] = deque(maxlen=WINDOW - 2 * REACH - 1)  # of positions 3 .. 8
    finest: deque[tuple[Tensor, Tensor]] = deque(maxlen=RADIUS - REACH + 1)  # R1, R2 of positions 5 .. 8
    for frame in _prepare(network, frames):
        window.append(frame)
        if len(window) < NEIGHBOURS:
            continue
        inside.append(_extract(network, list(window)[-NEIGHBOURS:]))
        if len(inside) > 1:
            r1, r2, entry = _encode(network, window[-1 - REACH], inside[-2], inside[-1])
            entries.append(entry)
            finest.append((r1, r2))
        if len(window) == WINDOW:
            start, end = _edges(network, window, inside)
            yield network.restore(network.recur([*start, *entries, *end]), *finest[0])[0]


def windows(network: nn.Module, frames: Iterable[Tensor]) -> Iterator[Tensor]:
    """Yield restored frames 5 .. T-6 of frames [B, 1, H, W]; windows share no work."""
    window: deque[Tensor] = deque(maxlen=WINDOW)
    for frame in frames:
        window.append(frame)
        if len(window) == WINDOW:
            yield network(torch.stack(list(window), dim=1)).scale1[:, 0]


def _prepare(network: QUIVER, frames: Iterable[Tensor]) -> Iterator[Frame]:
    """Yield each frame resized and pre-denoised, with the flow into the frame before."""
    before: Tensor | None = None
    for image in frames:
        denoised = network.denoise(image)
        height, width = image.shape[2:]
        images = (image, *(resize(image, height // k, width // k) for k in (2, 4)))
        yield Frame(images, denoised, None if before is None else network.flows(denoised, before))
        before = denoised


def _then_nothing(frames: Iterator[Frame]) -> Iterator[Frame | None]:
    """Yield the frames, then as many empty places as an extractor reaches ahead."""
    yield from frames
    yield from [None] * REACH


def _extract(network: QUIVER, places: Iterable[Frame | None]) -> Features:
    """Return the features of the middle of five places; None is beyond the window and counts as zeros."""
    five = list(places)
    like = next(frame for frame in five if frame is not None).denoised
    nothing = torch.zeros_like(like)
    noisy = torch.stack([nothing if f is None else f.images[0] for f in five], dim=2).flatten(1, 2)
    denoised = torch.stack([nothing if f is None else f.denoised for f in five], dim=2).flatten(1, 2)
    return Features(network.noisy_features(noisy), network.denoised_features(denoised))


def _encode(network: QUIVER, frame: Frame, before: Features | None, now: Features) -> Encoded:
    """Return R1, R2 and the cell's entry of a frame; `before` is None for the first frame of its window."""
    if before is None:
        return network.encode_first(frame.images)
    assert frame.flows is not None
    noisy = list(zip(before.noisy, now.noisy, strict=True))
    denoised = list(zip(before.denoised, now.denoised, strict=True))
    return network.encode_next(frame.images, noisy, denoised, frame.flows)


def _edges(network: QUIVER, window: Sequence[Frame], inside: Sequence[Features]) -> tuple[list[Tensor], list[Tensor]]:
    """Return the entries of window positions 0, 1, 2 and of 9, 10, which depend on zeros beyond the window."""
    outside: list[Frame | None] = [None] * REACH
    padded = [*outside, *window, *outside]
    at = {p: _extract(network, padded[p : p + NEIGHBOURS]) for p in (0, 1, WINDOW - 2, WINDOW - 1)}
    at |= {REACH: inside[0], WINDOW - 1 - REACH: inside[-1]}
    entries = [_encode(network, window[0], None, at[0])[2]]
    entries += [_encode(network, window[p], at[p - 1], at[p])[2] for p in (1, 2, WINDOW - 2, WINDOW - 1)]
    return entries[:3], entries[3:]
