"""Pictures: rendering through VTK, sheets of pictures, the interactive viewer, mesh levels."""
