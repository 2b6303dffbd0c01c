"""Find the run, moment and node that move most, and write that state as a surface for ParaView.

python examples/worst_moment.py kart.zarr worst.vtp
"""

import sys

import xarray as xr

ds = xr.open_dataset(sys.argv[1], engine="crashkit")  # chunks={} keeps memory small, where Dask is installed

size = ds.crash.magnitude("displacement")
place = {dim: int(k) for dim, k in size.argmax(["sim", "time", "node"]).items()}
worst = size.isel(place).compute()
print(
    f"{1e3 * float(worst):.0f} mm: run {worst.sim.item()}, {1e3 * float(worst.time):.1f} ms, node {int(ds.node_id[place['node']])}"
)

mesh = ds.crash.to_pyvista(sim=place["sim"], time=place["time"])
mesh.save(sys.argv[2])
before, after = ds.crash.surface(sim=place["sim"]).area, mesh.area
print(f"{sys.argv[2]}: {mesh.n_points} nodes, surface {100 * (after / before - 1):+.1f} % against the undeformed one")
