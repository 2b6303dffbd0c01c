"""What a surrogate knows before the first run: derived inputs, clock and size, symmetry."""
