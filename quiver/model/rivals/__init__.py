"""Defines the learned networks that QUIVER is compared with, one file each, under the names of their articles.

Every network has the same outside:

- `NAME(config=None)`, with a frozen `NAMEConfig` beside it: published sizes are the defaults, `width` scales them, and
  `as_published` brings back the handicaps of the published program where it has any.
- `network(frames)`: frames [B, T, 1, H, W] = codes/(2^b - 1) of any T, H and W >= 1 -> restored [B, T, 1, H, W], every
  frame, unclamped; ValueError for another shape or integers (`edges.check_frames`). Space is padded by repeating the
  edge (`edges.pad_space`), time by reflection (`edges.reflected`).
- `look_ahead`: the number of future frames that a restored frame uses; None if it uses all of them.

A network that restores one frame of a window has `frames_in`, the length of its window, and `windows(frames)`: frames
[B, T, 1, H, W], T >= frames_in, sides as inside -> those whose window lies in the clip [B, T - frames_in + 1, 1, H, W].

Those with published programs (EMVD, FloRNN, MemDeblur, RVRT, Spk2ImgNet) have published names in their state dict;
`load_published` of `quiver.model.published_weights` loads such a state. `unused` are beginnings of published names that
are declared there but never used, and not built here.
"""
