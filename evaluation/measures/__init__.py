"""What is measured: distances, tallies over runs, rigid motion, curves at probes, regions."""
