"""Benchmarks of studies: many trials on the workers of `dask.distributed`."""
