"""How much does the structure deform, beyond moving as a whole? One line a run, the worst first.

python examples/deformation_over_time.py kart.zarr
"""

import sys

import xarray as xr

ds = xr.open_dataset(sys.argv[1], engine="crashkit")  # chunks={} keeps memory small, where Dask is installed

ride = ds["displacement"].mean("node")  # what all nodes share, (sim, time, xyz)
deformation = ds.assign(deformation=ds["displacement"] - ride).crash.magnitude("deformation")
mean = deformation.mean("node").compute()  # (sim, time), m

peak = mean.max("time")
when = mean["time"].isel(time=mean.argmax("time"))
print(f"mean deformation of {ds.sizes['sim']} runs")
for run in peak.sortby(peak, ascending=False)["sim"].values[:5]:
    print(f"  {run}: {1e3 * float(peak.sel(sim=run)):6.1f} mm at {1e3 * float(when.sel(sim=run)):4.1f} ms")
