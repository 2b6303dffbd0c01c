"""The mesh hierarchy: the nodes that each level keeps, from the full mesh to the coarsest level."""

import pyvista as pv

import crashkit

mesh = crashkit.open_dataset("kart.zarr").crash.surface()
levels = crashkit.open_hierarchy("kart.zarr").levels
plot = pv.Plotter(off_screen=True, shape=(1, len(levels)), window_size=(1200, 400), border=False)
for column, level in enumerate(levels):
    plot.subplot(0, column)
    plot.add_mesh(mesh, color="lightgrey")
    plot.add_points(mesh.points[level.kept], color="crimson", point_size=7, render_points_as_spheres=True)
    plot.add_text(f"level {level.index}: {len(level.kept)} nodes", font_size=10)
plot.link_views()
plot.camera.zoom(1.2)
plot.screenshot("levels.png")
