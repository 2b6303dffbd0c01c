"""The page with sliders: what a model needs in a browser, and the page around it."""
