"""The displacement of one node of a test run over time, with the band that should contain 90 % of nodes and states."""

import matplotlib.pyplot as plt

import crashkit

run, node = crashkit.open_dataset("kart.zarr").sel(sim="run_031"), 1616
values = {name: float(run[name]) for name in run.crash.parameters}
prediction = crashkit.predict("pod-gpr", values, band=0.9).isel(node=node)
time, x, width = 1000 * run.time, 100 * prediction.displacement[:, 0], 100 * prediction.half_width
plt.fill_between(time, x - width, x + width, alpha=0.3, label="90 % band")
plt.plot(time, x, label="prediction")
plt.plot(time, 100 * run.displacement[:, node, 0], "k--", label="simulation")
plt.xlabel("time (ms)")
plt.ylabel("displacement in x (cm)")
plt.legend()
plt.savefig("band.png", dpi=120, bbox_inches="tight")
