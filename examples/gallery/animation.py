"""A test run over time: the simulation in grey, the prediction coloured by its error, as an animated GIF."""

import numpy as np
import pyvista as pv
from PIL import Image

import crashkit

run, pictures = crashkit.open_dataset("kart.zarr").sel(sim="run_031"), []
predicted = crashkit.predict("mh", {name: float(run[name]) for name in run.crash.parameters}, full=True)
for state in range(0, run.sizes["time"], 2):
    truth, mesh = run.crash.to_pyvista(time=state), run.crash.surface()
    mesh.points += predicted.values[state]
    mesh["error (cm)"] = 100 * np.linalg.norm(mesh.points - truth.points, axis=1)
    plot = pv.Plotter(off_screen=True, window_size=(640, 400))
    plot.add_mesh(truth, color="lightgrey")
    plot.add_mesh(mesh, scalars="error (cm)", cmap="inferno_r", clim=(0, 10))
    plot.camera.zoom(1.3)
    pictures.append(Image.fromarray(plot.screenshot(return_img=True)).quantize(64))
pictures[0].save("animation.gif", save_all=True, append_images=pictures[1:], duration=80, loop=0)
