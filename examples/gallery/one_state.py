"""One state of one run: the deformed frame, coloured by how far each node has moved."""

import pyvista as pv

import crashkit

runs = crashkit.open_dataset("kart.zarr")
plot = pv.Plotter(off_screen=True, window_size=(900, 600))
mesh = runs.crash.to_pyvista(sim="run_022", time=0.03)
plot.add_mesh(mesh, scalars="displacement", scalar_bar_args={"title": "displacement (m)"})
plot.camera_position = "iso"
plot.camera.zoom(1.4)
plot.screenshot("one_state.png")
