"""Mirbagheri et al. (2007), reproduced: every figure and number of the paper with ours beside it.

May import: plots, contours, identifiability, forward, solver, mechanics, mesh, sensor, measuring_chain, execution,
numerics.

    from pathlib import Path
    from isocharge.simulate.paper import write_paper

    write_paper(Path("paper"))
"""

from isocharge.simulate.paper.build import write_paper
from isocharge.simulate.paper.choices import Choices

__all__ = ["Choices", "write_paper"]
