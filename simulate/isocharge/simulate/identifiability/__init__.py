"""What charges can tell about a contact: Cramer-Rao limits, folds, ambiguities, working area, probe.

May import: forward, sensor, measuring_chain, numerics.
"""
