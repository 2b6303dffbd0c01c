"""Where the impact angle matters: derivative of the final displacement by the angle, from the model itself."""

import numpy as np
import pyvista as pv

import crashkit

model = crashkit.load_model("mh")
level = crashkit.open_hierarchy("kart.zarr").levels[0]
mesh = crashkit.open_dataset("kart.zarr").crash.surface()
derivative = model.surrogate.sensitivity([20.0, 10.0, 350e6], level=1)[-1, :, :, 1]  # speed, angle, yield stress
mesh["derivative"] = 100 * np.linalg.norm(level.to_full @ derivative, axis=1)
plot = pv.Plotter(off_screen=True, window_size=(900, 600))
bar = {"title": "cm per degree\n", "vertical": True, "position_x": 0.88, "position_y": 0.1, "height": 0.8}
plot.add_mesh(mesh, scalars="derivative", cmap="viridis", scalar_bar_args=bar)
plot.camera.zoom(1.3)
plot.screenshot("sensitivity.png")
