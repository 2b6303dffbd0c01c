"""One level, the cascade of levels, all levels at once, POD regression."""
