"""Eq. 4 and the thickness of the film: how charge grows with force."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from choices import PAPER, normalised_cubic
from entry import Entry, Row
from scipy.interpolate import CubicSpline
from solves import Solves

from isocharge.common.arrays import Array
from isocharge.simulate.plots.figure import COLOURS, FELT, INK, new_figure, shades

RANGE, BAND = (0.25, 2.0), 0.02
"""Range of forces of the comparison with eq. 4, N; largest difference of normalised charges that count as the same,
dimensionless."""

FINE = np.linspace(0.05, 2.0, 391)
"""Forces at which the solved charges are interpolated, N."""

SHOWN_N = (0.1, 0.5, 1.0, 2.0)
"""Forces at which the page gives the local exponent, N."""

LINEAR = 0.05
"""Largest distance from a straight line that counts as linear, over the charge at the end, dimensionless."""


@dataclass(frozen=True)
class ChargeForce:
    """Charge on A against force of one film.

    Attributes:
        thickness: mm.
        pretension: MPa.
        logs: Spline of ln Q (pC) in ln F (N).
    """

    thickness: float
    pretension: float
    logs: CubicSpline

    def charge(self, force: Array) -> Array:
        """pC, at forces of shape (n,), N."""
        charge: Array = np.exp(self.logs(np.log(force)))
        return charge

    def exponent(self, force: float) -> float:
        """d(ln Q)/d(ln F)."""
        return float(self.logs(np.log(force), 1))

    @property
    def at_1_N(self) -> float:
        """pC."""
        return float(self.charge(np.array([1.0]))[0])

    @property
    def misfit(self) -> float:
        """Largest distance from eq. 4's cubic, both over their charge at 1 N, over RANGE."""
        force = FINE[(RANGE[0] <= FINE) & (RANGE[1] >= FINE)]
        return float(np.abs(self.charge(force) / self.at_1_N - normalised_cubic(force)).max())

    def bent(self, force: float) -> float:
        """Distance from the best straight line through zero up to a force, over the charge there."""
        forces = FINE[force + 1e-9 >= FINE]
        charge = self.charge(forces)
        line = forces * (charge @ forces) / (forces @ forces)
        return float(np.abs(charge - line).max() / charge[-1])

    @property
    def cubic(self) -> Array:
        """Normalised cubic fitted over RANGE, falling powers of the force in N."""
        force = FINE[(RANGE[0] <= FINE) & (RANGE[1] >= FINE)]
        fitted: Array = np.polyfit(force, self.charge(force) / self.at_1_N, 3)
        return fitted


def films_of(solves: Solves) -> list[list[ChargeForce]]:
    """Charge against force, for every thickness a list with one curve for each pretension."""
    choices = solves.choices
    logs = np.log(np.array(choices.force))
    return [
        [
            ChargeForce(h, t, CubicSpline(logs, np.log(solves.chains[i, k, :, 0])))
            for k, t in enumerate(choices.pretension)
        ]
        for i, h in enumerate(choices.thickness)
    ]


def eq_4(solves: Solves) -> Entry:
    """The cubic, which film has it, and where charge is linear."""
    films = films_of(solves)
    figure = new_figure(15.5, 9.6)
    (curve, exponent), (misfit, bent) = figure.subplots(2, 2)
    _draw_curves(curve, films)
    _draw_exponents(exponent, films)
    _draw_grid(misfit, films, "distance from eq. 4's cubic, 0.25 to 2 N", lambda film: film.misfit, "{:.3f}")
    _draw_grid(
        bent,
        films,
        "distance from a straight line up to 0.5 N, % of the charge there",
        lambda film: 100 * film.bent(PAPER.linear_N),
        "{:.1f}",
    )
    rows = [*_rows_of_press(solves, films), *_rows_of_cubic(films), *_rows_of_line(films)]
    return Entry(
        "Eq. 4",
        "Charge of A against force at the place of eq. 4's press, films of several thicknesses and pretensions.",
        figure,
        rows,
        _numbers(solves, films),
    )


def _rows_of_press(solves: Solves, films: list[list[ChargeForce]]) -> list[Row]:
    """Where eq. 4's press was, and how large its charges are."""
    (x, y), factor = solves.eq_4
    pC, thick = [sum(cubic) for cubic in PAPER.cubics], films[-1]
    thick_pC, most = thick[0].at_1_N, max(film.at_1_N for film in thick)
    angle, away = np.rad2deg(np.arctan2(y + 10.0, x)), np.hypot(x, y + 10.0)
    ours = ", ".join(f"{factor * q:.0f}" for q in pC)
    return [
        Row(
            "where eq. 4's press was",
            "not given",
            f"({x:.2f}, {y:.2f}) mm: {away:.2f} mm from A at {angle:.0f}°",
            "from the ratios of its three charges at 1 N, on our film of 25 um; the scheme's presses are 4 mm from A",
        ),
        Row(
            "charges there at 1 N, A, B, C",
            ", ".join(f"{q:.0f}" for q in pC) + " pC (eq. 4, said to be 1 mm)",
            f"{ours} pC at 25 um",
            f"one factor of {factor:.2f} for all three (d31, E, probe): these are the charges of a film of 25 um",
        ),
        Row(
            f"can a film of {thick[0].thickness:g} mm give eq. 4's charges?",
            f"{pC[0]:.0f} pC on A at 1 N",
            f"no: {thick_pC:.1f} pC without pretension, at most {most:.1f} pC with it",
            f"{pC[0] / thick_pC:.0f} times too little: a thick film bends and hardly stretches",
        ),
    ]


def _rows_of_cubic(films: list[list[ChargeForce]]) -> list[Row]:
    """Which film has the shape of eq. 4."""
    flat = [film for row in films for film in row]
    thin, thick, cubic = films[0][0], films[-1], _poly(np.array(PAPER.cubics[0]) / sum(PAPER.cubics[0]))
    best, best_thick = min(flat, key=lambda film: film.misfit), min(thick, key=lambda film: film.misfit)
    same = [film for film in flat if film.misfit <= BAND]
    verdict = "yes" if best_thick.misfit <= BAND else "no"
    return [
        Row(
            f"can a film of {thick[0].thickness:g} mm give eq. 4's shape?",
            cubic,
            f"{verdict}: {_poly(thick[0].cubic)} without pretension; nearest {best_thick.misfit:.2f} away, "
            f"at {best_thick.pretension:g} MPa",
            "charge of A over its value at 1 N, a cubic of the force in N, 0.25 to 2 N",
        ),
        Row(
            f"the same at {_um(thin)}, no pretension",
            cubic,
            f"{_poly(thin.cubic)}; the curve is within {thin.misfit:.4f} of the paper's from 0.25 to 2 N",
            "charge goes with F^(2/3) on a slack membrane; a cubic with a constant at zero force is its fit",
        ),
        Row(
            f"films that fit eq. 4's cubic to {BAND:g}",
            "1 mm",
            _list(same) if same else "none",
            f"nearest: {_name(best)}, {best.misfit:.4f}; any film so thin that it stretches, and slack",
        ),
    ]


def _rows_of_line(films: list[list[ChargeForce]]) -> list[Row]:
    """Where charge goes with force."""
    thin = films[0][0]
    off = "; ".join(f"{_um(row[0])} {100 * row[0].bent(PAPER.linear_N):.0f} %" for row in films)
    exponents = "; ".join(f"{_um(row[0])} " + ", ".join(f"{row[0].exponent(f):.2f}" for f in SHOWN_N) for row in films)
    return [
        Row(
            f"linear up to {PAPER.linear_N:g} N",
            "yes (25 um)",
            f"{_um(thin)}, slack: {100 * thin.bent(PAPER.linear_N):.0f} % off a line; " + _linear_films(films),
            "F^(2/3) where stretching carries the load, F^2 where pretension or bending does; linear on the way",
        ),
        Row(
            "thicker is more linear",
            "linearity is enhanced, nonlinearity remains",
            f"{off} off a line up to {PAPER.linear_N:g} N, slack",
            "on the way from F^(2/3) to F^2 the exponent passes through 1 at some hundred um",
        ),
        Row(
            f"local exponent at {', '.join(f'{f:g}' for f in SHOWN_N)} N, slack",
            "not given",
            exponents,
            "2/3: membrane; 2: plate",
        ),
    ]


def _um(film: ChargeForce) -> str:
    return f"{1e3 * film.thickness:g} um"


def _name(film: ChargeForce) -> str:
    return f"{_um(film)} at {film.pretension:g} MPa"


def _list(films: list[ChargeForce]) -> str:
    return ", ".join(f"{_name(film)} ({film.misfit:.3f})" for film in sorted(films, key=lambda film: film.misfit))


def _poly(coefficients: Array) -> str:
    return "(" + ", ".join(f"{c:.4f}" for c in coefficients) + ")"


def _linear_films(films: list[list[ChargeForce]]) -> str:
    """Which films are linear up to 0.5 N."""
    linear = [film for row in films for film in row if film.bent(PAPER.linear_N) <= LINEAR]
    if not linear:
        return f"none within {100 * LINEAR:g} %"
    first = min(linear, key=lambda film: (film.thickness, film.pretension))
    names = ", ".join(f"{_name(film)} ({100 * film.bent(PAPER.linear_N):.1f} %)" for film in linear[:6])
    more = f" and {len(linear) - 6} more" if len(linear) > 6 else ""
    bends = f"; {_name(first)} then bends over, exponent {first.exponent(2.0):.2f} at 2 N"
    return f"within {100 * LINEAR:g} %: {names}{more}{bends}"


def _numbers(solves: Solves, films: list[list[ChargeForce]]) -> dict[str, Any]:
    (x, y), factor = solves.eq_4
    return {
        "press_of_eq_4_mm": [x, y],
        "our_charges_over_the_papers": factor,
        "force_N": list(solves.choices.force),
        "films": [
            {
                "thickness_um": 1e3 * film.thickness,
                "pretension_MPa": film.pretension,
                "charge_pC": (solves.chains[i, k]).tolist(),
                "misfit": film.misfit,
                "off_a_line_to_0.5_N": film.bent(PAPER.linear_N),
                "cubic": film.cubic.tolist(),
                "exponent": {f"{force:g}_N": film.exponent(force) for force in SHOWN_N},
            }
            for i, row in enumerate(films)
            for k, film in enumerate(row)
        ],
    }


def _chosen(films: list[list[ChargeForce]]) -> list[ChargeForce]:
    """25 um, 110 um and 1 mm, as far as they were solved, without pretension."""
    thicknesses = (0.025, 0.11, 1.0)
    return [row[0] for row in films if any(np.isclose(row[0].thickness, h) for h in thicknesses)]


def _draw_curves(axes: Any, films: list[list[ChargeForce]]) -> None:
    force = FINE[FINE >= 0.05]
    for cubic, name in zip(PAPER.cubics, "ABC", strict=True):
        style = {"A": "-", "B": "--", "C": ":"}[name]
        axes.plot(
            force, np.polyval(np.array(cubic) / sum(cubic), force), style, color=INK, lw=1.2, label=f"eq. 4, {name}"
        )
    axes.fill_between(force, normalised_cubic(force) - BAND, normalised_cubic(force) + BAND, color=INK, alpha=0.12)
    for film, colour in zip(_chosen(films), COLOURS, strict=False):
        axes.plot(
            force,
            film.charge(force) / film.at_1_N,
            color=colour,
            lw=1.6,
            label=f"{_name(film)}, {film.at_1_N:.{0 if film.at_1_N > 100.0 else 1}f} pC at 1 N",
        )
    axes.set(xlabel="force, N", ylabel="charge of A over its value at 1 N", title="Eq. 4: charge against force")
    axes.set_ylim(0, 3)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def _draw_exponents(axes: Any, films: list[list[ChargeForce]]) -> None:
    for row, colour in zip(films, shades(len(films)), strict=True):
        axes.semilogx(FINE, [row[0].exponent(f) for f in FINE], color=colour, label=_um(row[0]))
    taut = films[0][-1]
    axes.semilogx(FINE, [taut.exponent(f) for f in FINE], "--", color=FELT, label=_name(taut))
    for level in (2.0 / 3.0, 1.0, 2.0):
        axes.axhline(level, color=INK, lw=0.6, ls=":")
    axes.set(xlabel="force, N", ylabel="d(ln charge) / d(ln force)", title="local exponent, no pretension (one with)")
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))


def _draw_grid(axes: Any, films: list[list[ChargeForce]], title: str, value: Any, form: str) -> None:
    """A number for each thickness and pretension."""
    values = np.array([[value(film) for film in row] for row in films])
    axes.imshow(np.log10(values), cmap="viridis_r", aspect="auto")
    for i, row in enumerate(values):
        for k, number in enumerate(row):
            pale = np.log10(number) > np.log10(values).mean()
            axes.annotate(
                form.format(number), (k, i), ha="center", va="center", color="white" if pale else "black", fontsize=9
            )
    axes.set_xticks(range(values.shape[1]), [f"{film.pretension:g}" for film in films[0]])
    axes.set_yticks(range(values.shape[0]), [f"{1e3 * row[0].thickness:g}" for row in films])
    axes.set(xlabel="pretension, MPa", ylabel="thickness, um", title=title)
