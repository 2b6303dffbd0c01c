"""The displacement of one node of a test run over time, with the band that should contain 90 % of nodes and states."""

import matplotlib.pyplot as plt

import crashkit

runs = crashkit.open_dataset("kart.zarr")
run, node, model = runs.sel(sim="run_031"), 1616, crashkit.load_model("pod-gpr")
values = {name: float(run[name]) for name in runs.crash.parameters}
time, predicted = 1000 * run.time, 100 * crashkit.predict(model, values, full=True).displacement[:, node, 0]
width = 100 * model.surrogate.band(0.9)[:, node]
plt.fill_between(time, predicted - width, predicted + width, alpha=0.3, label="90 % band")
plt.plot(time, predicted, label="prediction")
plt.plot(time, 100 * run.displacement[:, node, 0], "k--", label="simulation")
plt.xlabel("time (ms)")
plt.ylabel("displacement in x (cm)")
plt.legend()
plt.savefig("band.png", dpi=120)
