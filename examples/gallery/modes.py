"""How far a linear reduction can go: share of the motion that the first POD modes leave out."""

import matplotlib.pyplot as plt
import numpy as np

import crashkit

train, _ = crashkit.open_dataset("kart.zarr").crash.split(test="27:36")
states = train.displacement.stack(state=("sim", "time"), row=("node", "xyz")).values
values = np.linalg.eigvalsh(states @ states.T)[::-1]  # squared singular values of the snapshots
left = np.sqrt(1 - np.cumsum(values) / values.sum())
plt.semilogy(range(1, 31), 100 * left[:30], "o-")
plt.xlabel("number of modes")
plt.ylabel("motion left out (%)")
plt.yticks([1, 2, 5, 10, 20, 50], [1, 2, 5, 10, 20, 50])
plt.savefig("modes.png", dpi=120, bbox_inches="tight")
