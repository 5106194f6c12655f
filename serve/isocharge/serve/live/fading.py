"""Functions that determine why the charges of a held press decrease.

The cause is either a leak of the amplifiers or creep of the film. A leak removes the same share of the charge in every
second. The logarithm of the charge Q is then a linear function of the time t since the touch, ln Q = a - t / tau. Creep
removes the same share of the charge in every decade of time. The logarithm of the charge Q is then a linear function of
ln t, ln Q = a + b ln t. Both functions are fitted to the charges of a press. One of the two causes is reported only if
the other function has a much larger sum of squared residuals: more than `MIN_RESIDUAL_RATIO` times as large.

A third possible cause is creep together with a thermoelastic step (see `isocharge.serve.signal_chain.memory`). The
third cause is reported only if the sum of squared residuals of both linear functions is more than
`MIN_RESIDUAL_RATIO` times as large as the sum of squared residuals of the third law.

The section [leak] of a device file corrects a leak, and the section [memory] corrects creep. If the section [leak] is
used to correct creep, the error of the charges increases with time.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.signal_chain.memory import MAX_CREEP, MemoryRule

MIN_RESIDUAL_RATIO = 9.0
"""Smallest ratio of the sums of the squared residuals of two laws for which the better law is reported.

With a smaller ratio, variations in the force of a hand could decide which law is reported.
"""

MIN_WINDOWS = 5
"""Smallest number of windows of a press to which the laws are fitted."""

UNDECIDED = (
    "or the amplifier leaks or the film creeps, which cannot be told apart yet: hold a press for several seconds, and "
    "set no [leak] before"
)
"""Advice to the user if no law fits clearly better than the others. The text is the end of a sentence."""


class Fading(NamedTuple):
    """Law by which the charges of a held press decrease.

    If no law fits clearly better than the other laws, all attributes have their default values.

    Attributes:
        tau_s: Time constant of the leak, s; None if the cause is not a leak.
        creep: Share of the charge that creep removes in each decade of time, dimensionless; None if the cause is not
            creep.
        thermoelastic: Share by which the thermoelastic step increases the charge at the beginning of the touch,
            dimensionless.
    """

    tau_s: float | None = None
    creep: float | None = None
    thermoelastic: float = 0.0

    @property
    def sections(self) -> dict[str, dict[str, float]]:
        """Sections of a device file that correct the decrease of the charges, with values of two significant digits.

        The result is a dictionary of sections by name. Each section is a dictionary of values by key. The section
        [leak] corrects a leak, and the section [memory] corrects creep. If no section can correct the decrease, or if
        its cause was not determined, the result is empty.
        """
        if self.tau_s is not None:
            return {"leak": {"tau_s": _two_digits(self.tau_s)}}
        if self.creep is None:
            return {}
        if self.creep >= MAX_CREEP:  # the section [memory] does not accept such a large creep
            return {}
        settings = {"creep": _two_digits(self.creep)}
        if self.thermoelastic > 0.0:
            settings["thermoelastic"] = _two_digits(self.thermoelastic)
        return {"memory": settings}

    @property
    def settings(self) -> str:
        """Text of `sections` in the form of a device file, such as `[leak] tau_s = 10`.

        The text is empty if there are no sections.
        """
        return " ".join(section_text(name, section) for name, section in self.sections.items())

    @property
    def creep_remedy(self) -> str:
        """Part of a sentence that advises the user how to reduce the error that creep causes."""
        if not self.settings:
            return "wait longer before each reading"
        return f"wait longer before each reading, or put {self.settings} into a device file"


def section_text(name: str, section: Mapping[str, float]) -> str:
    """Return a section of a device file as a single line of text, such as `[leak] tau_s = 10`."""
    assignments = ", ".join(f"{key} = {value:g}" for key, value in section.items())
    return f"[{name}] {assignments}"


def _two_digits(value: float) -> float:
    """Round a number to two significant digits."""
    return float(f"{value:.2g}")


class LineFit(NamedTuple):
    """Straight line that was fitted to points by least squares.

    Attributes:
        slope: Slope of the line.
        squared_residual: Sum of the squared residuals.
    """

    slope: float
    squared_residual: float


def law_of_fading(mean_magnitudes: Sequence[tuple[float, float]]) -> Fading:
    """Determine the law by which the charges of a press with a constant force decrease.

    Three laws are fitted to the mean magnitude Q of the charges, and the sums of their squared residuals are compared.
    With a leak, ln Q decreases linearly with time. With creep, ln Q decreases linearly with the logarithm of time. The
    third law combines creep with a thermoelastic step that decays exponentially.

    Args:
        mean_magnitudes: Pairs (t, Q). The first value is a time since the touch, s. The second value is the mean
            magnitude of the charges at this time, pC, which must be positive.

    Returns:
        The law with its parameters. All parameters have their default values, which state no law, if there are fewer
        than `MIN_WINDOWS` pairs, if the charges do not decrease, or if no law fits clearly better than the others.
    """
    if len(mean_magnitudes) < MIN_WINDOWS:
        return Fading()
    held_s, magnitude_pC = np.array(mean_magnitudes).T
    log_magnitude = np.log(magnitude_pC)
    leak_fit = _fit_line(held_s, log_magnitude)
    creep_fit = _fit_line(np.log(held_s), log_magnitude)
    is_decrease = leak_fit.slope < 0.0 and creep_fit.slope < 0.0
    if not is_decrease:
        return Fading()
    is_leak_clearly_better = creep_fit.squared_residual > MIN_RESIDUAL_RATIO * leak_fit.squared_residual
    if is_leak_clearly_better:
        return Fading(tau_s=-1.0 / leak_fit.slope)

    # Creep with a step is tested before creep alone, because creep alone may also fit clearly better than a leak. Creep
    # with a step has more parameters, and is only reported if it fits clearly better than both straight lines.
    max_squared_residual = min(leak_fit.squared_residual, creep_fit.squared_residual) / MIN_RESIDUAL_RATIO
    creep_and_step = _fit_creep_and_step(held_s, magnitude_pC, max_squared_residual)
    if creep_and_step is not None:
        return creep_and_step
    is_creep_clearly_better = leak_fit.squared_residual > MIN_RESIDUAL_RATIO * creep_fit.squared_residual
    if is_creep_clearly_better:
        log_change_per_decade = creep_fit.slope * np.log(10.0)
        relative_change_per_decade = float(np.expm1(log_change_per_decade))  # negative
        return Fading(creep=-relative_change_per_decade)
    return Fading()


def _fit_creep_and_step(held_s: Array, magnitude_pC: Array, max_squared_residual: float) -> Fading | None:
    """Fit creep with a thermoelastic step: Q = level - creep * log10(t) + step * exp(-t / warmth_s).

    Q is the mean magnitude of the charges, and t is the time since the touch in seconds. The time constant warmth_s
    describes how fast the film returns to the temperature of the air. It is set to its default value. A linear
    least-squares fit determines level, creep and step, which are charges in pC. The fit is physically possible if the
    ratios creep / level and step / level are between 0 and 1, and if all fitted charges are positive.

    Args:
        held_s: Times since the touch, shape (n,), s.
        magnitude_pC: Mean magnitudes of the charges at these times, shape (n,), pC.
        max_squared_residual: The fit is rejected unless the sum of the squared residuals of ln Q is smaller than this
            value.

    Returns:
        The fitted law, or None if the fit is rejected or physically impossible.
    """
    level_column = np.ones_like(held_s)
    creep_column = -np.log10(held_s)
    step_column = np.exp(-held_s / MemoryRule().warmth_s)
    design_matrix = np.column_stack([level_column, creep_column, step_column])
    coefficients = np.linalg.lstsq(design_matrix, magnitude_pC, rcond=None)[0]
    level_pC, creep_pC, step_pC = coefficients.tolist()
    fitted_pC = design_matrix @ coefficients
    are_ratios_possible = 0.0 < creep_pC < level_pC and 0.0 < step_pC < level_pC
    are_charges_possible = fitted_pC.min() > 0.0  # the logarithm below also needs positive values
    if not (are_ratios_possible and are_charges_possible):
        return None
    squared_residual = float(np.square(np.log(magnitude_pC / fitted_pC)).sum())
    if squared_residual >= max_squared_residual:
        return None
    return Fading(creep=creep_pC / level_pC, thermoelastic=step_pC / level_pC)


def cause_of_fading(mean_magnitudes: Sequence[tuple[float, float]]) -> str:
    """Return a text that states why the charges may decrease and advises the user what to do.

    The text is the second part of a sentence such as "the charges fall: hold the force; or the amplifier leaks". The
    caller adds the first part.

    Args:
        mean_magnitudes: Pairs of a time since the touch, s, and the mean magnitude of the charges at this time, pC. The
            magnitudes must be positive.
    """
    law = law_of_fading(mean_magnitudes)
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

    The slope is sum((x - mean(x)) * (y - mean(y))) / sum((x - mean(x))^2). The line passes through the point (mean(x),
    mean(y)).

    Args:
        x: First coordinates of the points, shape (n,). At least two of them must be different.
        y: Second coordinates of the points, shape (n,).
    """
    centred_x = x - x.mean()
    centred_y = y - y.mean()
    slope = float(centred_x @ centred_y) / float(centred_x @ centred_x)
    residuals = centred_y - slope * centred_x
    return LineFit(slope, squared_residual=float(np.square(residuals).sum()))
