"""500 crashes in seconds: largest displacement over impact speed and angle, by the surrogate."""

import matplotlib.pyplot as plt
import numpy as np

import crashkit

model = crashkit.load_model("mh")
speed, angle = np.linspace(6, 34, 25), np.linspace(-40, 40, 21)
crash = {"yield_stress": 350e6}
peak = [[abs(crashkit.predict(model, crash | {"impact_speed": s, "impact_angle": a}).displacement.values[-1]).max() for s in speed]
        for a in angle]  # fmt: skip
plt.contourf(speed, angle, 100 * np.array(peak), levels=12)
plt.colorbar(label="largest displacement in one direction (cm)")
plt.xlabel("impact speed (m/s)")
plt.ylabel("impact angle (degree)")
plt.savefig("response_surface.png", dpi=120)
