"""525 crashes in seconds: largest displacement over impact speed and angle, by the surrogate."""

import matplotlib.pyplot as plt
import numpy as np

import crashkit

speed, angle = np.meshgrid(np.linspace(6, 33, 25), np.linspace(-40, 40, 21))
crashes = {"impact_speed": speed.ravel(), "impact_angle": angle.ravel(), "yield_stress": np.full(speed.size, 350e6)}
prediction = crashkit.predict("mh", crashes, time=0.03, level=1)
peak = 100 * prediction.crash.magnitude("displacement").max("node").values.reshape(speed.shape)
plt.contourf(speed, angle, peak, levels=12)
plt.colorbar(label="largest displacement (cm)")
plt.xlabel("impact speed (m/s)")
plt.ylabel("impact angle (degree)")
plt.savefig("response_surface.png", dpi=120, bbox_inches="tight")
