"""Where the impact angle matters: derivative of the final displacement by the angle, from the model itself."""

import numpy as np
import pyvista as pv

import crashkit

model = crashkit.load_model("mh")
level = crashkit.open_hierarchy("kart.zarr").levels[0]
mesh = crashkit.open_dataset("kart.zarr").crash.surface()
derivative = model.surrogate.sensitivity([20.0, 10.0, 350e6], level=1)[-1, :, :, 1]  # speed, angle, yield stress
mesh["cm per degree"] = 100 * np.linalg.norm(level.to_full @ derivative, axis=1)
plot = pv.Plotter(off_screen=True, window_size=(900, 600))
plot.add_mesh(mesh, scalars="cm per degree", cmap="viridis")
plot.camera.zoom(1.4)
plot.screenshot("sensitivity.png")
