"""
# Bodies that bend

A skin follows joints: each vertex takes a share of the motion of some of them. Any motion can be a joint, in closed
form, so that flow is exact for every point of the skin. `animated_file("body.glb")` reads the same from a file.
"""

# %%
# A tentacle of six joints. Each turns about the top of its part and is carried by the one before it. Near a joint,
# the shares pass smoothly from one part to the next.

import matplotlib.pyplot as plt
import numpy as np

import qsim
from qsim.scene import (
    AreaLamp,
    Body,
    Camera,
    Constant,
    Diffuse,
    Joint,
    Pendulum,
    RoughPlastic,
    Scene,
    Skinned,
    Texture,
    Translation,
)
from qsim.scene.shapes import revolved, sheet
from qsim.scene.textures import checker

count, length = 6, 0.3
joints = tuple(
    Joint(Pendulum((0, -length * i / count, 0), (0, 0, 1), 0.35, 20.0, phase=-0.9 * i), parent=i - 1)
    for i in range(count)
)
along = np.linspace(1, 0, 61)
outline = 0.025 * (1 - 0.8 * along) * np.sqrt(1 - (2 * along - 1) ** 20)
skin = revolved(list(zip(outline, -length * along, strict=True)))
part = np.clip(-skin.vertices[:, 1] / length * count - 0.5, 0, count - 1)
first = np.minimum(part.astype(int), count - 2)
owners = np.stack([first, first + 1], axis=1)
shares = np.stack([1 - (part - first), part - first], axis=1)
motion = Skinned(skin.vertices, joints, owners, shares)

figure, axis = plt.subplots(figsize=(6, 4), layout="constrained")
for i in range(6):
    points = motion.deform(i / 120)
    axis.plot(*points[:: len(points) // 400].T[:2], ".", markersize=1.5, label=f"{i / 120 * 1e3:.0f} ms")
axis.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
axis.legend(loc="upper left", bbox_to_anchor=(1, 1))

# %%
# Rendered at 2000 frames per second. Flow, depth and body belong to the point of the skin behind each pixel.

height, frames = 96, 9  # tests: 12, 3
camera = Camera(8e-3, 2.8, 1.1e-6, 512, 768, origin=(0, -0.15, 6), target=(0, -0.15, 0))
wall = Body("wall", sheet(1.2, 0.8), Diffuse(0.4), Translation((0, 0, 0), (0, -0.15, -0.1)))
tentacle = Body("tentacle", skin, RoughPlastic(Texture(checker(8, 24, 0.05, 0.9)), 0.3), motion)
lamp = AreaLamp((0.6, 0.8, 2), (0, -0.15, 0), 0.5, 0.5, 30.0)
scene = Scene("tentacle", 0, camera, (Constant(0.2), lamp), (wall, tentacle))
clip = qsim.render(scene, frames=frames, height=height, width=height * 3 // 2, psnr=30)
stream = clip.sense("quiver-physical", ppp=3.25, bits=3)

middle = frames // 2
flow = clip.flow(middle)
pictures = {
    "radiance": clip.radiance(middle),
    "codes of 3 bits": stream.codes()[middle],
    "flow to the right [px]": flow[0],
}
figure, axes = plt.subplots(1, 3, figsize=(10, 2.6), layout="constrained")
for axis, (title, picture) in zip(axes, pictures.items(), strict=True):
    signed = {"cmap": "RdBu", "vmin": -1.5, "vmax": 1.5} if "flow" in title else {"cmap": "gray"}
    shown = axis.imshow(picture, **signed)
    axis.set_title(title)
    axis.axis("off")
figure.colorbar(shown, ax=axes[-1])

# %%
# The flow agrees with finite positions: points of the skin, moved by one frame and projected.

step = 1 / clip.frame_rate
t = middle * step
now, later = (clip.camera.project(motion.deform(time), time)[0] for time in (t, t + step))
inside = clip.body_id(middle) == 1
print(f"fastest point of the skin {np.hypot(*(later - now).T).max():.2f} px/frame")
print(f"largest flow in the picture {np.hypot(*flow)[inside].max():.2f} px/frame")
