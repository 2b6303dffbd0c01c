"""Meshes through VTK: surface, quadric selection, probe maps, hierarchy."""
