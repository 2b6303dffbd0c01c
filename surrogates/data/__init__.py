"""What a surrogate is trained on: campaign, graphs, samples, inputs."""
