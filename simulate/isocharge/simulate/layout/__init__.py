"""Where the electrodes should lie: charges of any layout from one solve, and the search for the best.

May import: identifiability, forward, solver, mesh, mechanics, sensor, measuring_chain, execution, numerics.
"""
