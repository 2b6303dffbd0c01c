"""The median of nine test runs over time: the simulation in grey, the prediction coloured by its error, as a GIF."""

import numpy as np
import pyvista as pv
from PIL import Image

import crashkit

run, pictures = crashkit.open_dataset("kart.zarr").sel(sim="run_034"), []
prediction = crashkit.predict("mh", {name: float(run[name]) for name in run.crash.parameters})
ends = run.crash.to_pyvista(time=0) + run.crash.to_pyvista(time=-1)  # the camera sees the first state and the last
bar = {"title": "error (cm)\n", "position_x": 0.2, "position_y": 0.8}
for state in range(run.sizes["time"]):
    truth, mesh = run.crash.to_pyvista(time=state), prediction.crash.to_pyvista(time=state)
    mesh["error"] = 100 * np.linalg.norm(mesh.points - truth.points, axis=1)
    plot = pv.Plotter(off_screen=True, window_size=(720, 540))
    plot.add_mesh(truth, color="lightgrey")
    plot.add_mesh(mesh, scalars="error", cmap="inferno_r", clim=(0, 5), scalar_bar_args=bar)
    plot.view_isometric(bounds=ends.bounds)
    plot.camera.zoom(1.2)
    pictures.append(Image.fromarray(plot.screenshot(return_img=True)).quantize(64))
pictures[0].save("animation.gif", save_all=True, append_images=pictures[1:], duration=100, loop=0)
