"""From states to latent vectors and back: graph, dense, POD."""
