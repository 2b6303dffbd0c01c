"""How far the structure moves in every run, on average over its nodes: faster impacts move it further."""

import matplotlib.pyplot as plt

import crashkit

runs = crashkit.open_dataset("kart.zarr")
motion = 100 * runs.crash.magnitude("displacement").mean("node").compute()
colours = plt.cm.viridis(runs.impact_speed / runs.impact_speed.max())
for curve, colour in zip(motion, colours, strict=True):
    plt.plot(1000 * runs.time, curve, color=colour)
plt.xlabel("time (ms)")
plt.ylabel("mean displacement (cm)")
plt.title("blue: slow, yellow: fast")
plt.savefig("motion_of_all_runs.png", dpi=120)
