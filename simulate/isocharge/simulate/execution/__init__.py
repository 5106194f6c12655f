"""Who computes: threads, worker processes, a Dask cluster; checkpoints, and the fingerprint of the code.

May import: nothing else of isocharge.simulate.
"""
