"""Where the electrodes should lie: charges of any layout from one solve, the search for the best, how it is made.

May import: identifiability, forward, solver, sensor, measuring_chain, execution, numerics.
"""
