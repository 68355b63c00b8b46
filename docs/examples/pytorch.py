"""
# Windows for your own PyTorch loop

Training windows are a plain `torch` data set: codes, truth and light, with new noise in every window.
"""

# %%
# `quiver.windows` takes a clip, a stream, or the folder of a data set. `Batches` numbers the windows of all steps, and
# every number has its own noise. A loader without it repeats the first epoch with the same noise.

import matplotlib.pyplot as plt
import torch
from torch.utils.data import DataLoader

import qsim
import quiver
from quiver.data.windows import Batches

side = 96  # tests: 32
steps = 24  # tests: 2
clip = qsim.render("plain", frames=12, height=side, width=side, speed=3, psnr=28)
stream = clip.sense("quiver-physical", bits=3, ppp=3.25)
windows = quiver.windows(stream, frames=5, crop=32)
loader = DataLoader(windows, batch_sampler=Batches(8, first=0, last=steps))
batch = next(iter(loader))
print({name: tuple(value.shape) for name, value in batch.items() if torch.is_tensor(value)})

# %%
# A network of three layers that sees five frames and returns the middle one. Codes and targets are both in units of
# white.

torch.manual_seed(0)
network = torch.nn.Sequential(
    torch.nn.Conv2d(5, 16, 3, padding=1),
    torch.nn.GELU(),
    torch.nn.Conv2d(16, 16, 3, padding=1),
    torch.nn.GELU(),
    torch.nn.Conv2d(16, 1, 3, padding=1),
)
optimiser = torch.optim.Adam(network.parameters(), 3e-3)
losses = []
for batch in loader:
    codes, target = batch["codes"][:, :, 0], batch["target"][:, 2]
    loss = torch.nn.functional.mse_loss(network(codes), target)
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    losses.append(loss.item())
print(f"loss {losses[0]:.4f} -> {losses[-1]:.4f}")

# %%
with torch.no_grad():
    middle = network(batch["codes"][:1, :, 0])[0, 0]
figure, axes = plt.subplots(1, 4, figsize=(10, 2.8), layout="constrained")
pictures = {"codes": batch["codes"][0, 2, 0], "network": middle, "truth": batch["target"][0, 2, 0]}
for axis, (title, picture) in zip(axes, pictures.items(), strict=False):
    axis.imshow(picture.numpy(), cmap="gray", vmin=0, vmax=1)
    axis.set_title(title)
    axis.axis("off")
axes[3].semilogy(losses)
axes[3].set(xlabel="step", title="loss")
