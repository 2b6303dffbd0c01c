"""From parameters and time to latent vectors: network, Gaussian process, latent process."""
