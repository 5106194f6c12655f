"""What presses tell of a film, in quantities that can be told: products and ratios beside single parameters.

Charges depend on Young's modulus, on the piezoelectric coefficients and on the gains almost only through their product,
on modulus and thickness through E h. A single one of them may be as uncertain after the calibration as before while the
product is known to a thousandth. So combinations are reported, each with its error, and single parameters are called
unknown where the presses said little.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.sensor.film_prior import FilmPrior

IDENTIFIED = 0.5
"""Standard deviation after the presses over that before, below which a quantity counts as told, dimensionless."""

PERCENT = ", over the described one"
"""How quantities are given whose size is described, but not known."""

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
        """Whether the presses have told it: its standard deviation at least halved."""
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


def quantities(prior: FilmPrior, parameters: Array, covariance: Array, before: Array) -> dict[str, Quantity]:
    """The quantities of a film by name.

    Args:
        prior: What the parameters are.
        parameters: The best, shape (n_parameter,).
        covariance: After the presses, of the parameters over their prior standard deviations.
        before: The same before the presses.
    """
    return {
        name: Quantity(
            name,
            meaning,
            value=float(offset + row @ parameters),
            std=_std(row * prior.std, covariance),
            before_std=_std(row * prior.std, before),
            weights=row * prior.std,
        )
        for name, (meaning, offset, row) in _rows(prior).items()
    }


def _std(row: Array, covariance: Array) -> float:
    return float(np.sqrt(row @ covariance @ row))


def _rows(prior: FilmPrior) -> Mapping[str, tuple[str, float, Array]]:
    """Name to meaning, value at parameters of zero, and weight of each parameter."""
    names, electrodes = list(prior.names), prior.sensor.electrode_names
    calibration = prior.sensor.calibration

    def row(**weights: float) -> Array:
        values = np.zeros(len(names))
        for name, weight in weights.items():
            values[names.index(name.replace("__", " "))] = weight
        return values

    mean_gain = {f"gain__{name}": 1.0 / len(electrodes) for name in electrodes}
    table = {
        "pretension_MPa": ("pretension", 0.0, row(pretension=1e-6)),
        "response_percent": (
            f"charge of a press on the slack film, E^(1/3) h^(-2/3) sqrt(d31 d32) gain{PERCENT}, %",
            0.0,
            100.0 * row(young=1.0 / 3.0, thickness=-2.0 / 3.0, d31=0.5, d32=0.5, **mean_gain),
        ),
        "charge_scale_percent": (
            f"product of Young's modulus, sqrt(d31 d32) and mean gain{PERCENT}, %",
            0.0,
            100.0 * row(young=1.0, d31=0.5, d32=0.5, **mean_gain),
        ),
        "stiffness_percent": (
            f"Young's modulus times thickness{PERCENT}, %",
            0.0,
            100.0 * row(young=1.0, thickness=1.0),
        ),
        "anisotropy_percent": (f"ratio of d31 to d32{PERCENT}, %", 0.0, 100.0 * row(d31=1.0, d32=-1.0)),
        "shift_x_mm": ("shift of the electrodes along x", 1e3 * calibration.shift[0], row(shift_x=1e3)),
        "shift_y_mm": ("shift of the electrodes along y", 1e3 * calibration.shift[1], row(shift_y=1e3)),
        "rotation_deg": (
            "turn of the electrodes",
            float(np.rad2deg(calibration.rotation)),
            row(rotation=float(np.rad2deg(1.0))),
        ),
        "probe_radius_mm": ("radius of the probe", 1e3 * prior.probe.radius, row(probe_radius=1e3)),
    }
    for name in electrodes:
        among = mean_gain | {f"gain__{name}": 1.0 - 1.0 / len(electrodes)}
        among = {key: value if key == f"gain__{name}" else -value for key, value in among.items()}
        table[f"gain_{name}_percent"] = (f"gain of {name} over the mean of all gains, %", 0.0, 100.0 * row(**among))
    alone = {
        "young_percent": ("Young's modulus by itself", row(young=1.0)),
        "thickness_percent": ("thickness by itself", row(thickness=1.0)),
        "d31_percent": ("d31 by itself", row(d31=1.0)),
        "d32_percent": ("d32 by itself", row(d32=1.0)),
        "mean_gain_percent": ("mean gain by itself", row(**mean_gain)),
    }
    table |= {name: (f"{meaning}{PERCENT}, %", 0.0, 100.0 * weights) for name, (meaning, weights) in alone.items()}
    return table


def in_words(table: Mapping[str, Quantity]) -> tuple[str, ...]:
    """What the presses tell and what they cannot, a sentence each."""
    known = [quantity for quantity in table.values() if quantity.identified]
    unknown = [quantity for quantity in table.values() if not quantity.identified]
    sentences = [f"Known now: {_listed(known)}."] if known else []
    if unknown:
        sentences.append(
            "These presses cannot tell "
            + ", ".join(quantity.meaning.removesuffix(", %").removesuffix(PERCENT) for quantity in unknown)
            + "; what is given for them is hardly more than what was assumed before."
        )
    if not table["young_percent"].identified and table["response_percent"].identified:
        sentences.append(
            "Young's modulus, piezoelectric coefficients and gain cannot be told apart; what they give together, the "
            f"charge of a press, is known to {table['response_percent'].std:.2g} %, and that is what contacts need."
        )
    return tuple(sentences)


def _listed(known: list[Quantity]) -> str:
    return ", ".join(f"{quantity.name} {quantity.value:.3g} +- {quantity.std:.2g}" for quantity in known)
