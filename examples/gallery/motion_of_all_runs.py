"""How far the structure moves in every run, on average over its nodes: faster impacts move it further."""

import matplotlib.pyplot as plt

import crashkit

runs = crashkit.open_dataset("kart.zarr")
motion = 100 * runs.crash.magnitude("displacement").mean("node").compute()
speed = plt.cm.ScalarMappable(plt.Normalize(float(runs.impact_speed.min()), float(runs.impact_speed.max())))
for curve, colour in zip(motion, speed.to_rgba(runs.impact_speed), strict=True):
    plt.plot(1000 * runs.time, curve, color=colour)
plt.xlabel("time (ms)")
plt.ylabel("mean displacement (cm)")
plt.colorbar(speed, ax=plt.gca(), label="impact speed (m/s)")
plt.savefig("motion_of_all_runs.png", dpi=120, bbox_inches="tight")
