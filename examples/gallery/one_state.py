"""One state of one run: the deformed frame, coloured by how far each node has moved."""

import pyvista as pv

import crashkit

runs = crashkit.open_dataset("kart.zarr")
plot = pv.Plotter(off_screen=True, window_size=(900, 600))
mesh = runs.crash.to_pyvista(sim="run_022", time=0.03)
bar = {"title": "displacement (m)\n", "vertical": True, "position_x": 0.86, "position_y": 0.1, "height": 0.8}
plot.add_mesh(mesh, scalars="displacement", scalar_bar_args=bar)
plot.camera_position = "iso"
plot.camera.zoom(1.3)
plot.screenshot("one_state.png")
