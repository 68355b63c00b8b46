"""
# A scene of your own

A scene is a frozen record: a camera, lights, and bodies that move. Lengths are in metres, times in seconds, angles in
radians.
"""

# %%
# A gear and a printed plate before a wall. `Spin` turns about an axis; motions are functions of time, so the renderer
# may ask for any instant.

import matplotlib.pyplot as plt
import numpy as np

import qsim
from qsim.scene import AreaLamp, Body, Camera, Constant, Diffuse, RoughPlastic, Scene, Spin, Texture, Translation
from qsim.scene.props import gear, letters
from qsim.scene.shapes import sheet
from qsim.scene.textures import noise

width = 256  # tests: 32
frames = 9  # tests: 3
rng = np.random.default_rng(0)

camera = Camera(focal_length=8e-3, f_number=2.8, pixel_pitch=1.1e-6, height=512, width=1024, origin=(0, 0, 3))
wall = Body("wall", sheet(1.0, 0.6), Diffuse(Texture(noise(rng, (256, 256)))), Translation((0, 0, 0), (0, 0, -0.1)))
turning = Translation((0, 0, 0), (-0.09, 0, 0)) @ Spin((0, 0, 1), 90.0)
wheel = Body("wheel", gear(14, 0.085, 0.03, spokes=5), RoughPlastic(0.5, 0.2), turning)
word = Body("word", letters("QIS", 0.08, 0.02), Diffuse(0.7), Translation((2.0, 0, 0), (0.02, -0.03, 0)))
lights = (Constant(0.3), AreaLamp((0.5, 0.8, 1.2), (0, 0, 0), 0.4, 0.4, 20.0))
scene = Scene("workshop", 0, camera, lights, (wall, wheel, word))
print(scene)

# %%
# `psnr` is the error that you ask for, in decibels below white; bounces and samples follow from it. The clip states
# the error it reached.

clip = qsim.render(scene, frames=frames, height=width // 2, width=width, psnr=32)
print(clip)
print(f"error {clip.info.psnr_of_truth:.1f} dB below white")

# %%
# Every clip has ground truth: depth, flow to the next frame, and the body that each pixel sees.

middle = frames // 2
flow = clip.flow(middle)
figure, axes = plt.subplots(2, 2, figsize=(9, 5), layout="constrained")
for axis, (title, picture, colours) in zip(
    axes.flat,
    [
        ("radiance", clip.radiance(middle) ** (1 / 2.2), "gray"),
        ("depth [m]", clip.depth(middle), "viridis"),
        ("speed [px/frame]", np.hypot(*flow), "magma"),
        ("body", clip.body_id(middle), "tab10"),
    ],
    strict=True,
):
    axis.imshow(picture, cmap=colours)
    axis.set_title(title)
    axis.axis("off")
