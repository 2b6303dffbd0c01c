"""Which parameter drives the crash, and does a plain power law predict runs it has not seen?

    python examples/speed_and_strength.py kart.zarr 27:36

The second argument names the runs left out of the fit.
"""

import sys

import numpy as np
import xarray as xr

ds = xr.open_dataset(sys.argv[1], engine="crashkit")  # chunks={} keeps memory small, where Dask is installed
ds["peak"] = ds.crash.magnitude("displacement").max(["time", "node"]).compute()

print("correlation with the largest displacement")
for name in ds.crash.parameters:
    print(f"  {name:<14} {float(xr.corr(ds[name], ds['peak'])):+.2f}")

train, test = ds.crash.split(test=sys.argv[2] if len(sys.argv) > 2 else 0.25)
strongest = max(ds.crash.parameters, key=lambda name: abs(float(xr.corr(train[name], train["peak"]))))
law = np.log(train["peak"]).assign_coords(x=np.log(train[strongest])).swap_dims(sim="x").polyfit("x", 1)
exponent, scale = (float(law.polyfit_coefficients.sel(degree=d)) for d in (1, 0))
predicted = np.exp(scale) * test[strongest] ** exponent
error = float(abs(predicted / test["peak"] - 1).mean())
print(
    f"peak = {np.exp(scale):.3g} * {strongest}^{exponent:.2f}: {100 * error:.0f} % off on {test.sizes['sim']} test runs"
)
