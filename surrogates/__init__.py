"""Surrogates in torch: Chebyshev operator, one level, the cascade, baselines, training, storage.

Arrays and sparse matrices in, arrays out: nothing here knows a solver, VTK or xarray.
"""
