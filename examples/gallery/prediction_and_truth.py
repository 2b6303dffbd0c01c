"""A test run at its end: the simulation in grey, the prediction coloured by its error."""

import numpy as np
import pyvista as pv

import crashkit

run = crashkit.open_dataset("kart.zarr").sel(sim="run_031")
prediction = crashkit.predict("mh", {name: float(run[name]) for name in run.crash.parameters})
truth, mesh = run.crash.to_pyvista(time=0.03), prediction.crash.to_pyvista(time=0.03)
mesh["error (cm)"] = 100 * np.linalg.norm(mesh.points - truth.points, axis=1)
plot = pv.Plotter(off_screen=True, window_size=(900, 600))
plot.add_mesh(truth, color="lightgrey")
plot.add_mesh(mesh, scalars="error (cm)", cmap="inferno_r")
plot.camera.zoom(1.4)
plot.screenshot("prediction_and_truth.png")
