"""Where long work is done: this process, worker processes, a Dask cluster; and the fingerprint of the code."""
