"""Many trials through the same steps on the workers of `dask.distributed`, and the table and page of a study."""
