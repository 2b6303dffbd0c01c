"""From a campaign to a surrogate: starts, objectives, the loop, checkpoints, refinement."""
