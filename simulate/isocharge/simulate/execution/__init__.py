"""Execution of long computations in this process, in worker processes on this machine, or on a Dask cluster."""
