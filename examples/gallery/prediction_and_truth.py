"""A test run at its end: the simulation in grey, the prediction coloured by its error."""

import numpy as np
import pyvista as pv

import crashkit

run = crashkit.open_dataset("kart.zarr").sel(sim="run_031")
prediction = crashkit.predict("mh", {name: float(run[name]) for name in run.crash.parameters})
truth, mesh = run.crash.to_pyvista(time=0.03), prediction.crash.to_pyvista(time=0.03)
mesh["error"] = 100 * np.linalg.norm(mesh.points - truth.points, axis=1)
plot = pv.Plotter(off_screen=True, window_size=(900, 600))
plot.add_mesh(truth, color="lightgrey")
bar = {"title": "error (cm)\n", "vertical": True, "position_x": 0.88, "position_y": 0.1, "height": 0.8}
plot.add_mesh(mesh, scalars="error", cmap="inferno_r", scalar_bar_args=bar)
plot.camera.zoom(1.3)
plot.screenshot("prediction_and_truth.png")
