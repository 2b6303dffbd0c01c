"""Questions about the next runs: which to compute, and whether there are enough. Arrays in, arrays out."""
