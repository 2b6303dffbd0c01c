"""A surrogate as a folder: weights, card, export."""
