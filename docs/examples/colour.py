"""
# Colour behind a mosaic

A scene in red, green and blue, seen through three colour filter arrays. Codes stay one mosaic, which every method
restores.
"""

# %%
# Any family has colours with `bands="rgb"`. The clip holds three bands per frame.

import matplotlib.pyplot as plt
import numpy as np

import qsim
import quiver

side = 64  # tests: 16
clip = qsim.render("tumble", frames=11, height=side, width=side, seed=2, psnr=30, bands="rgb")
print(clip[5].shape, [f"{wavelength * 1e9:.0f} nm" for wavelength in clip.bands])

# %%
# The same light through an RGGB, a quad Bayer and an RGBW array. Without given efficiencies a filter passes its band,
# and W passes all three: its pixels are brighter.

streams = {mask: clip.sense("quiver-physical", ppp=8, bits=5, colour=mask) for mask in ("rggb", "quad", "rgbw")}
for mask, stream in streams.items():
    codes, tile = stream.codes(), stream.colour_filter.mask
    means = {tile[i][j]: codes[:, i :: len(tile), j :: len(tile)].mean() for i, j in np.ndindex(len(tile), len(tile))}
    print(mask, ", ".join(f"mean code of {colour} {mean:.1f}" for colour, mean in sorted(means.items())))

# %%
# Each place of the mask is restored alone, and demosaicing finds the bands. Scores are means over the bands.

videos = {mask: quiver.restore(stream, "moment") for mask, stream in streams.items()}
truth = streams["rggb"].truth(5, 6)[0]
figure, axes = plt.subplots(1, 5, figsize=(11, 2.6), layout="constrained")
shown = {"truth": truth, "codes, rggb": streams["rggb"][5] / 31 * truth.max(), **{m: v[5] for m, v in videos.items()}}
for axis, (name, light) in zip(axes, shown.items(), strict=True):
    picture = np.clip(light / np.percentile(truth, 99.5), 0, 1) ** (1 / 2.2)
    axis.imshow(picture if picture.ndim == 2 else np.moveaxis(picture, 0, -1), cmap="gray", vmin=0, vmax=1)
    axis.set(title=name, xticks=[], yticks=[])
for mask, video in videos.items():
    print(mask, f"{quiver.score(video, streams[mask]).psnr:.1f} dB")
