"""Error of two models over time, on average over nodes and test runs."""

import matplotlib.pyplot as plt
import numpy as np

import crashkit

_, test = crashkit.open_dataset("kart.zarr").crash.split(test="27:36")
for name in ("mh", "pod-gpr"):
    model = crashkit.load_model(name)
    values = test[test.crash.parameters].to_dataframe().to_dict("records")
    errors = [crashkit.predict(model, v, full=True).displacement.values for v in values] - test.displacement.values
    plt.plot(1000 * test.time, 100 * np.linalg.norm(errors, axis=-1).mean((0, 2)), label=name)
plt.xlabel("time (ms)")
plt.ylabel("mean node error (cm)")
plt.legend()
plt.savefig("error_over_time.png", dpi=120)
