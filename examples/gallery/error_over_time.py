"""Error of two models over time, on average over nodes and test runs."""

import matplotlib.pyplot as plt
import numpy as np

import crashkit

_, test = crashkit.open_dataset("kart.zarr").crash.split(test="27:36")
for name in ("mh", "pod-gpr"):
    prediction = crashkit.predict(name, {parameter: test[parameter].values for parameter in test.crash.parameters})
    difference = prediction.displacement.values - test.displacement.values  # (sim, time, node, xyz), m
    plt.plot(1000 * test.time, 100 * np.linalg.norm(difference, axis=-1).mean((0, 2)), label=name)
plt.xlabel("time (ms)")
plt.ylabel("mean node error (cm)")
plt.legend()
plt.savefig("error_over_time.png", dpi=120, bbox_inches="tight")
