"""Cause of a decrease of the charges of a held press: a leak of the amplifier, or creep of the film.

A leak removes the same share of the charge in every second. Creep removes the same share in every decade of time. Let t
be the time since the touch. With a leak, ln Q = a - t / tau is a straight line over t. With creep, ln Q = a + b ln t is
a straight line over ln t. Both lines are fitted to the charges of a press. A law is only reported if the squared
residuals of the other law are at least `MIN_RESIDUAL_RATIO` times as large. A third law is creep with a thermoelastic
step (see `isocharge.serve.signal_chain.memory`). This law is reported if the squared residuals of both lines are at
least `MIN_RESIDUAL_RATIO` times as large.

The section [leak] of a device file corrects a leak, and the section [memory] corrects creep. If [leak] is used for
creep, the error grows with time.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.signal_chain.memory import MAX_CREEP, MemoryRule

MIN_RESIDUAL_RATIO = 9.0
"""Smallest ratio of the squared residuals of two laws with which the better law is reported.

With a smaller ratio, the variations of the force of a hand could determine the result.
"""

MIN_WINDOWS = 5
"""Smallest number of charges of a press that are compared."""

UNDECIDED = (
    "or the amplifier leaks or the film creeps, which cannot be told apart yet: hold a press for several seconds, and "
    "set no [leak] before"
)
"""Advice if neither law fits clearly better; the end of a sentence."""


class Fading(NamedTuple):
    """The law by which the charges of a press decrease.

    All values have their defaults if no law fits clearly better than the others.

    Attributes:
        tau_s: Time constant of a leak, s.
        creep: Share of the charge that creep removes in each decade of time, dimensionless.
        thermoelastic: Share by which the charge is larger at the beginning of the touch, dimensionless.
    """

    tau_s: float | None = None
    creep: float | None = None
    thermoelastic: float = 0.0

    @property
    def sections(self) -> dict[str, dict[str, float]]:
        """Sections of a device file that correct the decrease, with values of two digits.

        The section [leak] corrects a leak with the time constant `tau_s`. The section [memory] corrects creep. The
        result is empty if no section corrects the decrease.
        """
        if self.tau_s is not None:
            return {"leak": {"tau_s": _two_digits(self.tau_s)}}
        if self.creep is None:
            return {}
        if self.creep >= MAX_CREEP:  # the section [memory] refuses so large a creep
            return {}
        settings = {"creep": _two_digits(self.creep)}
        if self.thermoelastic:
            settings["thermoelastic"] = _two_digits(self.thermoelastic)
        return {"memory": settings}

    @property
    def settings(self) -> str:
        """The sections as the user writes them, such as `[leak] tau_s = 10`; empty if there are none."""
        return " ".join(section_text(name, section) for name, section in self.sections.items())

    @property
    def creep_remedy(self) -> str:
        """Advice to the user on how to deal with creep, as a part of a sentence."""
        if not self.settings:
            return "wait longer before each reading"
        return f"wait longer before each reading, or put {self.settings} into a device file"


def section_text(name: str, section: Mapping[str, float]) -> str:
    """Return a section of a device file in one line, such as `[leak] tau_s = 10`."""
    assignments = ", ".join(f"{key} = {value:g}" for key, value in section.items())
    return f"[{name}] {assignments}"


def _two_digits(value: float) -> float:
    """Round a number to two significant digits."""
    return float(f"{value:.2g}")


class LineFit(NamedTuple):
    """A straight line that was fitted to points.

    Attributes:
        slope: Slope of the line.
        squared_residual: Sum of the squared residuals.
    """

    slope: float
    squared_residual: float


def law_of_fading(sizes: Sequence[tuple[float, float]]) -> Fading:
    """Determine the law by which the charges of a press with a constant force decrease.

    Three laws are fitted to the mean magnitude Q of the charges, and compared by their squared residuals. With a leak,
    ln Q falls linearly with time. With creep, ln Q falls linearly with the logarithm of time. The third law is creep
    with a thermoelastic step, which decays exponentially.

    Args:
        sizes: Pairs (t, Q) of a time since the touch, s, and the mean magnitude of the charges at this time, positive,
            pC.

    Returns:
        The law with its parameters. The parameters have their defaults if there are too few times, if the charges do
        not decrease, or if no law fits clearly better than the others.
    """
    if len(sizes) < MIN_WINDOWS:
        return Fading()
    held_s, size_pC = np.array(sizes).T
    log_size = np.log(size_pC)
    leak_fit = _fit_line(held_s, log_size)
    creep_fit = _fit_line(np.log(held_s), log_size)
    if max(leak_fit.slope, creep_fit.slope) >= 0.0:  # the charges do not decrease
        return Fading()
    is_leak_clearly_better = creep_fit.squared_residual > MIN_RESIDUAL_RATIO * leak_fit.squared_residual
    if is_leak_clearly_better:
        return Fading(tau_s=-1.0 / leak_fit.slope)

    # Creep with a step is tested before creep alone, and is only reported if it fits clearly better than both lines.
    max_squared_residual = min(leak_fit.squared_residual, creep_fit.squared_residual) / MIN_RESIDUAL_RATIO
    creep_and_step = _fit_creep_and_step(held_s, size_pC, max_squared_residual)
    if creep_and_step is not None:
        return creep_and_step
    is_creep_clearly_better = leak_fit.squared_residual > MIN_RESIDUAL_RATIO * creep_fit.squared_residual
    if is_creep_clearly_better:
        log_change_per_decade = creep_fit.slope * np.log(10.0)
        return Fading(creep=-float(np.expm1(log_change_per_decade)))
    return Fading()


def _fit_creep_and_step(held_s: Array, size_pC: Array, max_squared_residual: float) -> Fading | None:
    """Fit creep with a thermoelastic step: Q = level - creep * log10(t) + step * exp(-t / warmth_s).

    The time constant warmth_s, with which the film takes the temperature of the air, has its default. The three other
    parameters are then coefficients of a linear least-squares problem. They are physical if the shares creep / level
    and step / level lie between 0 and 1.

    Args:
        held_s: Times since the touch, shape (n,), s.
        size_pC: Mean magnitudes of the charges, shape (n,), pC.
        max_squared_residual: Sum of the squared residuals of ln Q above which the fit is rejected.

    Returns:
        The law; None if the fit is rejected, or its parameters are not physical.
    """
    level_column = np.ones_like(held_s)
    creep_column = -np.log10(held_s)
    step_column = np.exp(-held_s / MemoryRule().warmth_s)
    design_matrix = np.column_stack([level_column, creep_column, step_column])
    coefficients = np.linalg.lstsq(design_matrix, size_pC, rcond=None)[0]
    level_pC, creep_pC, step_pC = coefficients.tolist()
    fitted_pC = design_matrix @ coefficients
    has_physical_shares = 0.0 < creep_pC < level_pC and 0.0 < step_pC < level_pC
    if not has_physical_shares or fitted_pC.min() <= 0.0:
        return None
    squared_residual = float(np.square(np.log(size_pC / fitted_pC)).sum())
    if squared_residual >= max_squared_residual:
        return None
    return Fading(creep=creep_pC / level_pC, thermoelastic=step_pC / level_pC)


def cause_of_fading(sizes: Sequence[tuple[float, float]]) -> str:
    """Return the end of a sentence that states the possible cause of a decrease and gives advice to the user.

    Args:
        sizes: Pairs of a time since the touch, s, and the mean magnitude of the charges at this time, positive, pC.
    """
    law = law_of_fading(sizes)
    if law.tau_s is not None:  # a leak
        return f"or the amplifier leaks: then put {law.settings} into a device file"
    if law.creep is not None:
        return (
            f"or the film creeps, by {100.0 * law.creep:.2g} % in each decade of time: {law.creep_remedy}; this is no "
            "leak, so set no [leak] for it"
        )
    return UNDECIDED


def _fit_line(x: Array, y: Array) -> LineFit:
    """Fit a straight line to points by least squares.

    The slope is sum((x - mean(x)) * (y - mean(y))) / sum((x - mean(x))^2). The line passes through the mean point.

    Args:
        x: First coordinates of the points, shape (n,).
        y: Second coordinates of the points, shape (n,).
    """
    centred_x = x - x.mean()
    centred_y = y - y.mean()
    slope = float(centred_x @ centred_y) / float(centred_x @ centred_x)
    squared_residual = float(np.square(centred_y - slope * centred_x).sum())
    return LineFit(slope, squared_residual)
