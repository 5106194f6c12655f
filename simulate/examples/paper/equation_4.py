"""Eq. 4: the charge as a function of the force, for films of several thicknesses and pretensions."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from axes import finish_axes, new_axes, shades
from choices import CUBICS, LINEAR_N
from page import Entry, Row
from scipy.interpolate import CubicSpline
from solves import Solves

from isocharge.common.arrays import Array
from isocharge.simulate.plots.figure import COLOURS, FELT, INK

BAND = 0.02
"""Largest difference of normalised charges that count as the same, dimensionless."""

FINE = np.linspace(0.05, 2.0, 391)
"""Forces at which the solved charges are interpolated, N."""

COMPARED = FINE[(FINE >= 0.25) & (FINE <= 2.0)]
"""Forces at which the charges are compared with eq. 4, N."""

SHOWN_N = (0.1, 0.5, 1.0, 2.0)
"""Forces at which the page gives the local exponent, N."""

LINEAR = 0.05
"""Largest ratio of the distance from a straight line to the charge at its end that counts as linear, dimensionless."""


@dataclass(frozen=True)
class ChargeForce:
    """Charge of A as a function of the force for one film.

    Attributes:
        thickness: Thickness of the film, mm.
        pretension: Pretension of the film, MPa.
        charges: Solved charges of all electrodes, shape (n_force, 3), pC.
        log_charge: Spline of the logarithm of the charge (pC) of A as a function of the logarithm of the force (N).
    """

    thickness: float
    pretension: float
    charges: Array
    log_charge: CubicSpline

    def charge(self, force: Array | float) -> Array:
        """Return the charges (pC) at forces (N)."""
        return np.exp(self.log_charge(np.log(force)))

    def exponent(self, force: float) -> float:
        """Return the local exponent d(ln Q)/d(ln F) at a force (N)."""
        return float(self.log_charge(np.log(force), 1))

    @property
    def at_1_N(self) -> float:
        """Charge at 1 N, pC."""
        return float(self.charge(1.0))

    @property
    def misfit(self) -> float:
        """Largest difference from the cubic of eq. 4, if both are divided by their charge at 1 N."""
        return float(np.abs(self.charge(COMPARED) / self.at_1_N - normalised(CUBICS[0], COMPARED)).max())

    @property
    def bent(self) -> float:
        """Largest distance from the best straight line up to `LINEAR_N`, over the charge at `LINEAR_N`."""
        forces = FINE[FINE <= LINEAR_N + 1e-9]
        return distance_from_line(forces, self.charge(forces))

    @property
    def cubic(self) -> Array:
        """Coefficients of the cubic that fits the charge over its value at 1 N, highest power of the force first."""
        return np.polyfit(COMPARED, self.charge(COMPARED) / self.at_1_N, 3)

    @property
    def um(self) -> str:
        """Thickness as a text."""
        return f"{1e3 * self.thickness:g} um"

    @property
    def name(self) -> str:
        """Thickness and pretension as a text."""
        return f"{self.um} at {self.pretension:g} MPa"


def normalised(cubic: tuple[float, ...], force: Array) -> Array:
    """Evaluate a cubic of eq. 4, divided by its value at 1 N."""
    return np.polyval(np.array(cubic) / sum(cubic), force)


def distance_from_line(force: Array, charge: Array) -> float:
    """Compute the largest distance of a charge from the best straight line, over the charge at the largest force.

    The line need not go through zero, because the cubic of eq. 4 does not either.
    """
    line = np.polyval(np.polyfit(force, charge, 1), force)
    return float(np.abs(charge - line).max() / charge[-1])


def eq_4(solves: Solves) -> Entry:
    """Return the entry about eq. 4: which films have its cubic, and where the charge is linear in the force."""
    choices = solves.choices
    films = [
        [
            ChargeForce(thickness, pretension, charges, CubicSpline(np.log(choices.force), np.log(charges[:, 0])))
            for pretension, charges in zip(choices.pretension, of_thickness, strict=True)
        ]
        for thickness, of_thickness in zip(choices.thickness, solves.chains, strict=True)
    ]
    figure, ((curve, exponent), (misfit, bent)) = new_axes(15.5, 9.6, 2, 2)
    _draw_curves(curve, films)
    _draw_exponents(exponent, films)
    _draw_grid(misfit, films, "distance from eq. 4's cubic, 0.25 to 2 N", [[f.misfit for f in row] for row in films], 3)
    away = [[100 * film.bent for film in row] for row in films]
    _draw_grid(bent, films, "distance from a straight line up to 0.5 N, % of the charge there", away, 1)
    numbers = {
        "press_of_eq_4_mm": [*solves.eq_4[0]],
        "our_charges_over_the_papers": solves.eq_4[1],
        "force_N": list(choices.force),
        "films": [
            {
                "thickness_um": 1e3 * film.thickness,
                "pretension_MPa": film.pretension,
                "charge_pC": film.charges.tolist(),
                "misfit": film.misfit,
                "off_a_line_to_0.5_N": film.bent,
                "cubic": film.cubic.tolist(),
                "exponent": {f"{force:g}_N": film.exponent(force) for force in SHOWN_N},
            }
            for row in films
            for film in row
        ],
    }
    return Entry(
        "Eq. 4",
        "Charge of A against force at the position of the press of eq. 4, for several thicknesses and pretensions.",
        figure,
        [*_rows_of_press(solves, films[-1]), *_rows_of_cubic(films), *_rows_of_line(films)],
        numbers,
    )


def _rows_of_press(solves: Solves, thick: list[ChargeForce]) -> list[Row]:
    """Return the rows about the position of the press of eq. 4 and the size of its charges."""
    ((x, y), factor), pC = solves.eq_4, [sum(cubic) for cubic in CUBICS]
    thick_pC = thick[0].at_1_N
    most = max(film.at_1_N for film in thick)
    angle = np.rad2deg(np.arctan2(y + 10.0, x))
    away = np.hypot(x, y + 10.0)
    return [
        Row(
            "position of the press of eq. 4",
            "not given",
            f"({x:.2f}, {y:.2f}) mm, which is {away:.2f} mm from A at {angle:.0f}°",
            "computed from the ratios of its three charges at 1 N for a film of 25 um; the first presses of the lines "
            "in the paper are 4 mm from A",
        ),
        Row(
            "charges of A, B and C at this position at 1 N",
            ", ".join(f"{q:.0f}" for q in pC) + " pC (eq. 4, for a film of 1 mm according to the paper)",
            ", ".join(f"{factor * q:.0f}" for q in pC) + " pC for 25 um",
            f"all three charges differ by the same factor of {factor:.2f}, which d31, E or the probe may explain: "
            "eq. 4 describes a film of 25 um",
        ),
        Row(
            f"does a film of {thick[0].thickness:g} mm have the charges of eq. 4?",
            f"{pC[0]:.0f} pC on A at 1 N",
            f"no: {thick_pC:.1f} pC without pretension, and at most {most:.1f} pC with pretension",
            f"the charge of eq. 4 is {pC[0] / thick_pC:.0f} times as large; a thick film bends and hardly stretches",
        ),
    ]


def _rows_of_cubic(films: list[list[ChargeForce]]) -> list[Row]:
    """Return the rows about the films whose charge has the shape of eq. 4."""
    thin = films[0][0]
    thick = films[-1]
    cubic = _coefficients(np.array(CUBICS[0]) / sum(CUBICS[0]))
    nearest, best_thick = (
        sorted(some, key=lambda film: film.misfit) for some in ([film for row in films for film in row], thick)
    )
    same = ", ".join(f"{film.name} ({film.misfit:.3f})" for film in nearest if film.misfit <= BAND)
    return [
        Row(
            f"does the curve of a film of {thick[0].thickness:g} mm have the shape of eq. 4?",
            cubic,
            f"{'yes' if best_thick[0].misfit <= BAND else 'no'}: {_coefficients(thick[0].cubic)} without pretension; "
            f"the smallest difference is {best_thick[0].misfit:.2f}, for {best_thick[0].pretension:g} MPa",
            "coefficients of a cubic of the force in N, for the charge of A relative to its value at 1 N, from 0.25 to "
            "2 N",
        ),
        Row(
            f"does the curve of a film of {thin.um} without pretension have this shape?",
            cubic,
            f"{_coefficients(thin.cubic)}; the curve differs by at most {thin.misfit:.4f} from 0.25 to 2 N",
            "the charge of a membrane without pretension is proportional to F^(2/3); a cubic that is fitted to it is "
            "not zero at zero force",
        ),
        Row(
            f"films whose curve differs from eq. 4 by at most {BAND:g}",
            "1 mm",
            same or "none",
            f"the smallest difference is {nearest[0].misfit:.4f}, for {nearest[0].name}; thin films without pretension "
            "have nearly the same curve",
        ),
    ]


def _rows_of_line(films: list[list[ChargeForce]]) -> list[Row]:
    """Return the rows about the films whose charge is linear in the force."""
    slack = [row[0] for row in films]
    line_differences = "; ".join(f"{film.um} {100 * film.bent:.0f} %" for film in slack)
    forces = FINE[FINE <= LINEAR_N + 1e-9]
    paper_percent = 100.0 * distance_from_line(forces, normalised(CUBICS[0], forces))
    exponents = "; ".join(f"{film.um} " + ", ".join(f"{film.exponent(f):.2f}" for f in SHOWN_N) for film in slack)
    return [
        Row(
            f"linear up to {LINEAR_N:g} N",
            "yes (25 um)",
            f"{slack[0].um} without pretension: {100 * slack[0].bent:.1f} % from a line with an offset, eq. 4: "
            f"{paper_percent:.1f} %; " + _linear_films(films),
            "the charge is proportional to F^(2/3) if stretching carries the load, and to F^2 if pretension or bending "
            "does; between these cases, it is nearly linear",
        ),
        Row(
            "a thicker film is more linear",
            "linearity is enhanced, nonlinearity remains",
            f"differences from a line up to {LINEAR_N:g} N without pretension: {line_differences}",
            "between F^(2/3) and F^2, the exponent is 1 at a thickness of some hundred um",
        ),
        Row(
            f"local exponent at {', '.join(f'{f:g}' for f in SHOWN_N)} N without pretension",
            "not given",
            exponents,
            "the exponent is 2/3 for a membrane and 2 for a plate",
        ),
    ]


def _coefficients(cubic: Array) -> str:
    """Format the coefficients of a cubic."""
    return "(" + ", ".join(f"{c:.4f}" for c in cubic) + ")"


def _linear_films(films: list[list[ChargeForce]]) -> str:
    """List the films whose charge is linear up to 0.5 N, beginning with the thinnest film."""
    linear = [film for row in films for film in row if film.bent <= LINEAR]
    if not linear:
        return f"none within {100 * LINEAR:g} %"
    names = ", ".join(f"{film.name} ({100 * film.bent:.1f} %)" for film in linear[:6])
    more = f" and {len(linear) - 6} more" if len(linear) > 6 else ""
    exponent = f"the exponent of {linear[0].name} at 2 N is {linear[0].exponent(2.0):.2f}"
    return f"within {100 * LINEAR:g} %: {names}{more}; {exponent}"


def _draw_curves(axes: Any, films: list[list[ChargeForce]]) -> None:
    """Draw eq. 4 and the charges of films of 25 um, 110 um and 1 mm without pretension, if they were solved."""
    for cubic, name, style in zip(CUBICS, "ABC", ("-", "--", ":"), strict=True):
        axes.plot(FINE, normalised(cubic, FINE), style, color=INK, lw=1.2, label=f"eq. 4, {name}")
    papers = normalised(CUBICS[0], FINE)
    axes.fill_between(FINE, papers - BAND, papers + BAND, color=INK, alpha=0.12)
    chosen = [row[0] for row in films if np.isclose(row[0].thickness, (0.025, 0.11, 1.0)).any()]
    for film, colour in zip(chosen, COLOURS, strict=False):
        label = f"{film.name}, {film.at_1_N:.{0 if film.at_1_N > 100.0 else 1}f} pC at 1 N"
        axes.plot(FINE, film.charge(FINE) / film.at_1_N, color=colour, lw=1.6, label=label)
    axes.set_ylim(0, 3)
    finish_axes(axes, "force, N", "charge of A over its value at 1 N", "Eq. 4: charge against force")


def _draw_exponents(axes: Any, films: list[list[ChargeForce]]) -> None:
    for row, colour in zip(films, shades(len(films)), strict=True):
        axes.semilogx(FINE, [row[0].exponent(f) for f in FINE], color=colour, label=row[0].um)
    taut = films[0][-1]
    axes.semilogx(FINE, [taut.exponent(f) for f in FINE], "--", color=FELT, label=taut.name)
    for level in (2.0 / 3.0, 1.0, 2.0):
        axes.axhline(level, color=INK, lw=0.6, ls=":")
    title = "local exponent, no pretension (one with)"
    place = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.0)}
    finish_axes(axes, "force, N", "d(ln charge) / d(ln force)", title, **place)


def _draw_grid(axes: Any, films: list[list[ChargeForce]], title: str, values: list[list[float]], digits: int) -> None:
    """Draw a table with one value for each thickness and pretension, with shades for the values."""
    logs = np.log10(values)
    axes.imshow(logs, cmap="viridis_r", aspect="auto")
    for (i, k), log in np.ndenumerate(logs):
        ink = "white" if log > logs.mean() else "black"
        axes.annotate(f"{values[i][k]:.{digits}f}", (k, i), ha="center", va="center", color=ink, fontsize=9)
    axes.set_xticks(range(len(films[0])), [f"{film.pretension:g}" for film in films[0]])
    axes.set_yticks(range(len(films)), [f"{1e3 * row[0].thickness:g}" for row in films])
    axes.set(xlabel="pretension, MPa", ylabel="thickness, um", title=title)
