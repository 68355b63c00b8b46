"""The learned networks that QUIVER is compared with, one file each, under their published names.

Every network has the same outside:

- `NAME(config=None)`, with a frozen `NAMEConfig` beside it: published sizes are the defaults, `width` scales them, and
  `as_published` brings back the handicaps of the published program where it has any.
- `network(frames)`: frames [B, T, 1, H, W] = codes/(2^b - 1) of any T, H and W >= 1 -> restored [B, T, 1, H, W], every
  frame, unclamped; ValueError for another shape or integers (`edges.check_frames`). Space is padded by repeating the
  edge (`edges.pad_space`), time by reflection (`edges.reflected`).
- `look_ahead`: the number of future frames that a restored frame uses; None if it uses all of them.
- `unused`: beginnings of published names that are declared there but never used, and not built here.
- The names of its state dict are the published ones; `published_names.load_published` loads such a state.
"""
