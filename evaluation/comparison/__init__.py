"""Models against the truth: the split they agree on, predictors, scores of runs, the result."""
