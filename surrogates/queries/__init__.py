"""Questions that take thousands of predictions: which parameters explain a measurement, which keep a limit best."""
