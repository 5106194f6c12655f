"""Quantities of a film that presses can identify: products and ratios beside single parameters.

Charges depend on Young's modulus, on the piezoelectric coefficients and on the gains almost only through their product,
on modulus and thickness through E h. A single parameter may be as uncertain after the calibration as before while the
product has an error of a thousandth. Combinations are therefore reported, each with its error, and single parameters
are called unknown where the presses hardly reduced their standard deviation.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.sensor.film_prior import FilmPrior
from isocharge.train.calibration.problem import IDENTIFIED, FilmEstimate

PERCENT = ", over the described one"
"""Words behind quantities that are relative to the described value."""

BY_ITSELF = ("young_percent", "thickness_percent", "d31_percent", "d32_percent", "mean_gain_percent")
"""Quantities that presses identify only in products."""

SHOWN = 5
"""Quantities in a sentence, the first; the card has a table of all."""

NORMAL_95 = 1.959964
"""Half width of a 95 % interval in standard deviations."""


@dataclass(frozen=True)
class Quantity:
    """One quantity of the film.

    Attributes:
        name: What it is, with its unit: "pretension_MPa", "charge_scale".
        meaning: In words.
        value: Best estimate.
        std: Standard deviation.
        before_std: Standard deviation before the presses.
        weights: Its weights of the parameters over their prior standard deviations, shape (n_parameter,).
    """

    name: str
    meaning: str
    value: float
    std: float
    before_std: float
    weights: Array

    @property
    def identified(self) -> bool:
        """Whether the presses have at least halved its standard deviation."""
        return self.std <= IDENTIFIED * self.before_std

    @property
    def interval_95(self) -> tuple[float, float]:
        """Ends of the 95 % interval."""
        half = NORMAL_95 * self.std
        return self.value - half, self.value + half

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        table = {key: value for key, value in asdict(self).items() if key not in ("name", "weights")}
        return table | {"interval_95": list(self.interval_95), "identified": self.identified}


def quantities(prior: FilmPrior, film: FilmEstimate) -> dict[str, Quantity]:
    """Return the quantities of a film by name, beside the standard deviations of the described sensor alone."""

    def std(row: Array, covariance: Array) -> float:
        return float(np.sqrt(row @ covariance @ row))

    return {
        name: Quantity(
            name,
            meaning,
            value=float(offset + row @ film.parameters),
            std=std(row * prior.std, film.covariance),
            before_std=std(row * prior.std, np.eye(row.size)),
            weights=row * prior.std,
        )
        for name, (meaning, offset, row) in _rows(prior).items()
    }


def _rows(prior: FilmPrior) -> dict[str, tuple[str, float, Array]]:
    """Return meaning, value at parameters of zero, and weight of each parameter, by the name of the quantity."""
    unit = dict(zip(prior.names, np.eye(len(prior.names)), strict=True))
    gains = {name: unit[f"gain {name}"] for name in prior.sensor.electrode_names}
    mean_gain = sum(gains.values(), np.zeros(len(unit))) / len(gains)
    response = 0.5 * (unit["d31"] + unit["d32"]) + mean_gain
    of_slack_film = (unit["young"] - 2.0 * unit["thickness"]) / 3.0 + response
    placed = prior.sensor.calibration
    degrees = float(np.rad2deg(1.0))

    def relative(meaning: str, weights: Array) -> tuple[str, float, Array]:
        return f"{meaning}{PERCENT}, %", 0.0, 100.0 * weights

    return {
        "pretension_MPa": ("pretension", 0.0, unit["pretension"]),
        "response_percent": relative(
            "charge of a press on the slack film, E^(1/3) h^(-2/3) sqrt(d31 d32) gain", of_slack_film
        ),
        "charge_scale_percent": relative(
            "product of Young's modulus, sqrt(d31 d32) and mean gain", unit["young"] + response
        ),
        "stiffness_percent": relative("Young's modulus times thickness", unit["young"] + unit["thickness"]),
        "anisotropy_percent": relative("ratio of d31 to d32", unit["d31"] - unit["d32"]),
        "shift_x_mm": ("shift of the electrodes along x", placed.shift[0], unit["shift_x"]),
        "shift_y_mm": ("shift of the electrodes along y", placed.shift[1], unit["shift_y"]),
        "rotation_deg": ("turn of the electrodes", degrees * placed.rotation, degrees * unit["rotation"]),
        "probe_radius_mm": ("radius of the probe", prior.probe.radius, unit["probe_radius"]),
        **{
            f"gain_{name}_percent": (f"gain of {name} over the mean of all gains, %", 0.0, 100.0 * (gain - mean_gain))
            for name, gain in gains.items()
        },
        "young_percent": relative("Young's modulus by itself", unit["young"]),
        "thickness_percent": relative("thickness by itself", unit["thickness"]),
        "d31_percent": relative("d31 by itself", unit["d31"]),
        "d32_percent": relative("d32 by itself", unit["d32"]),
        "mean_gain_percent": relative("mean gain by itself", mean_gain),
    }


def summarise(table: Mapping[str, Quantity]) -> tuple[str, ...]:
    """Return sentences on the quantities that the presses identify, and on those that they do not identify."""
    identified = [quantity for quantity in table.values() if quantity.identified]
    unidentified = [quantity for quantity in table.values() if not quantity.identified]
    sentences = []
    if identified:
        listed = ", ".join(f"{each.name} {each.value:.3g} +- {each.std:.2g}" for each in identified[:SHOWN])
        more = f" and {len(identified) - SHOWN} more, on the card" if len(identified) > SHOWN else ""
        sentences.append(f"Known now: {listed}{more}.")
    if unidentified:
        meanings = [each.meaning.removesuffix(", %").removesuffix(PERCENT) for each in unidentified]
        sentences.append(
            f"These presses cannot tell {', '.join(meanings)}; what is given for them is hardly more than what was "
            "assumed before."
        )
    factors = [each.name.removesuffix("_percent") for each in unidentified if each.name in BY_ITSELF]
    response = table["response_percent"]
    if len(factors) > 1 and response.identified:
        sentences.append(
            f"{', '.join(factors)}: only what they give together, the "
            f"charge of a press, is known to {response.std:.2g} %, and that is what contacts need."
        )
    return tuple(sentences)
