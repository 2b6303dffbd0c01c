"""Where the runs lie in the space of the design parameters, and which of them are held out for testing."""

import matplotlib.pyplot as plt

import crashkit

runs = crashkit.open_dataset("kart.zarr")
for part, label in zip(runs.crash.split(test="27:36"), ("training", "test"), strict=True):
    size = part.yield_stress / 1e6 / 5  # the third parameter, as the area of the dot
    plt.scatter(part.impact_speed, part.impact_angle, s=size, alpha=0.6, label=label)
plt.xlabel("impact speed (m/s)")
plt.ylabel("impact angle (degree)")
low, high = float(runs.yield_stress.min()) / 1e6, float(runs.yield_stress.max()) / 1e6
title = f"area of a dot: yield stress, {low:.0f} to {high:.0f} MPa"
plt.legend(title=title, loc="lower center", bbox_to_anchor=(0.5, 1), ncols=2, frameon=False)
plt.savefig("design_space.png", dpi=120, bbox_inches="tight")
