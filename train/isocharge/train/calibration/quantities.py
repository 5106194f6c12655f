"""Quantities of a film that presses can identify, such as products and ratios of parameters.

The charges depend on Young's modulus E, the piezoelectric coefficients and the gains almost only through the product of
these parameters. Similarly, the charges depend on E and the thickness h almost only through the product E h. Therefore,
a calibration may determine a product of parameters accurately although each single parameter remains uncertain. For
this reason, products and ratios of parameters are reported with their own standard deviations. A quantity counts as
identified if the presses reduced its standard deviation by at least half.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.sensor.film_prior import FilmPrior
from isocharge.train.calibration.problem import MAX_IDENTIFIED_STD_RATIO, FilmEstimate

RELATIVE = " relative to the sensor file"
"""Text that is appended to the description of a quantity whose value is relative to the sensor file."""

SINGLE_PARAMETERS = ("young_percent", "thickness_percent", "d31_percent", "d32_percent", "mean_gain_percent")
"""Names of quantities that consist of a single parameter, which presses often identify only in products with others."""

SHOWN_IN_SENTENCE = 5
"""Largest number of quantities in a sentence. The model card has a table of all quantities."""

NORMAL_95 = 1.959964
"""Half width of a 95 % interval of the normal distribution, in standard deviations."""


@dataclass(frozen=True)
class Quantity:
    """A quantity of the film, with its standard deviations before and after the presses.

    Attributes:
        name: Name of the quantity with its unit, such as "pretension_MPa".
        meaning: Description of the quantity in words.
        value: Best estimate after the presses.
        std: Standard deviation after the presses.
        before_std: Standard deviation before the presses.
        weights: Derivatives of the quantity with respect to the parameters in units of their prior standard
            deviations, shape (n_parameter,).
    """

    name: str
    meaning: str
    value: float
    std: float
    before_std: float
    weights: Array

    @property
    def identified(self) -> bool:
        """Whether the presses have reduced the standard deviation of the quantity by at least half."""
        return self.std <= MAX_IDENTIFIED_STD_RATIO * self.before_std

    @property
    def interval_95(self) -> tuple[float, float]:
        """Lower and upper end of the 95 % interval after the presses."""
        half_width = NORMAL_95 * self.std
        return self.value - half_width, self.value + half_width

    def to_dict(self) -> dict[str, Any]:
        """Convert the quantity into a dictionary for JSON. The dictionary does not contain the name and the weights."""
        table = {key: value for key, value in asdict(self).items() if key not in ("name", "weights")}
        return table | {"interval_95": list(self.interval_95), "identified": self.identified}


class _Definition(NamedTuple):
    """Definition of a quantity as a linear function of the parameters.

    Attributes:
        meaning: Description of the quantity in words.
        weights: Derivatives with respect to the parameters in their own units, shape (n_parameter,).
        offset: Value of the quantity if all parameters are zero.
    """

    meaning: str
    weights: Array
    offset: float = 0.0


def quantities(prior: FilmPrior, before: FilmEstimate, film: FilmEstimate) -> dict[str, Quantity]:
    """Return the quantities of a film by name, each with its standard deviations before and after the presses.

    Args:
        prior: Distribution of the films, with the prior standard deviations of the parameters.
        before: Estimate of the film before the presses, for example from an earlier calibration.
        film: Estimate of the film after the presses.
    """
    quantity_of_name = {}
    for name, definition in _definitions(prior).items():
        # A quantity is a weighted sum of the parameters. The covariance is in units of the prior standard deviations of
        # the parameters, so the weights are converted to these units.
        scaled_weights = definition.weights * prior.std
        quantity_of_name[name] = Quantity(
            name,
            definition.meaning,
            value=float(definition.offset + definition.weights @ film.parameters),
            std=float(np.sqrt(scaled_weights @ film.covariance @ scaled_weights)),
            before_std=float(np.sqrt(scaled_weights @ before.covariance @ scaled_weights)),
            weights=scaled_weights,
        )
    return quantity_of_name


def _definitions(prior: FilmPrior) -> dict[str, _Definition]:
    """Return the definitions of all quantities by name.

    The parameters include the logarithms of Young's modulus, the thickness, the piezoelectric coefficients and the
    gains. Therefore, the logarithm of a product of such properties is a weighted sum of parameters.

    Args:
        prior: Distribution of the films, with the names of the parameters and electrodes.
    """
    # A quantity is defined by the weights of the parameters. The weights of a quantity that is a single parameter are
    # the unit vector of this parameter.
    unit = dict(zip(prior.names, np.eye(len(prior.names)), strict=True))
    gains = {name: unit[f"gain {name}"] for name in prior.sensor.electrode_names}
    mean_gain = sum(gains.values(), np.zeros(len(unit))) / len(gains)
    piezo_times_gain = 0.5 * (unit["d31"] + unit["d32"]) + mean_gain  # sqrt(d31 d32) times the mean gain
    # Without pretension, the charge of a press is proportional to E^(1/3) h^(-2/3) sqrt(d31 d32) and to the gain.
    slack_response = (unit["young"] - 2.0 * unit["thickness"]) / 3.0 + piezo_times_gain
    # The parameters of shift and rotation are differences from the sensor file, so the values in the file are added.
    file_calibration = prior.sensor.calibration
    x_shift_mm, y_shift_mm = file_calibration.shift
    degrees_per_rad = float(np.rad2deg(1.0))
    definitions = {
        "pretension_MPa": _Definition("pretension", unit["pretension"]),
        "response_percent": _percent_definition(
            "charge of a press on the slack film, E^(1/3) h^(-2/3) sqrt(d31 d32) gain", slack_response
        ),
        "charge_scale_percent": _percent_definition(
            "product of Young's modulus, sqrt(d31 d32) and mean gain", unit["young"] + piezo_times_gain
        ),
        "stiffness_percent": _percent_definition("Young's modulus times thickness", unit["young"] + unit["thickness"]),
        "anisotropy_percent": _percent_definition("ratio of d31 to d32", unit["d31"] - unit["d32"]),
        "shift_x_mm": _Definition("shift of the electrodes along x", unit["shift_x"], x_shift_mm),
        "shift_y_mm": _Definition("shift of the electrodes along y", unit["shift_y"], y_shift_mm),
        "rotation_deg": _Definition(
            "rotation of the electrodes",
            degrees_per_rad * unit["rotation"],
            degrees_per_rad * file_calibration.rotation,
        ),
        "probe_radius_mm": _Definition("radius of the probe", unit["probe_radius"], prior.probe.radius),
    }
    for name, gain in gains.items():
        meaning = f"gain of {name} relative to the mean of all gains, %"
        definitions[f"gain_{name}_percent"] = _Definition(meaning, 100.0 * (gain - mean_gain))
    definitions["young_percent"] = _percent_definition("Young's modulus alone", unit["young"])
    definitions["thickness_percent"] = _percent_definition("thickness alone", unit["thickness"])
    definitions["d31_percent"] = _percent_definition("d31 alone", unit["d31"])
    definitions["d32_percent"] = _percent_definition("d32 alone", unit["d32"])
    definitions["mean_gain_percent"] = _percent_definition("mean gain alone", mean_gain)
    return definitions


def _percent_definition(meaning: str, log_weights: Array) -> _Definition:
    """Define a quantity in percent, as the difference from its value in the sensor file.

    Args:
        meaning: Description of the quantity in words.
        log_weights: Derivatives of the logarithm of the quantity with respect to the parameters, shape (n_parameter,).
    """
    return _Definition(f"{meaning}{RELATIVE}, %", 100.0 * log_weights)


def summarise(table: Mapping[str, Quantity]) -> tuple[str, ...]:
    """Return sentences about the identified and the unidentified quantities.

    The charge of a press depends on a combination of single parameters. If several of these parameters are not
    identified but the combination is, a further sentence states how accurately the charge is known.

    Args:
        table: The quantities by name, as `quantities` returns them.
    """
    identified = [quantity for quantity in table.values() if quantity.identified]
    unidentified = [quantity for quantity in table.values() if not quantity.identified]
    sentences = []
    if identified:
        shown_quantities = identified[:SHOWN_IN_SENTENCE]
        values_text = ", ".join(
            f"{quantity.name} {quantity.value:.3g} +- {quantity.std:.2g}" for quantity in shown_quantities
        )
        remaining_count = len(identified) - len(shown_quantities)
        if remaining_count:
            values_text += f" and {remaining_count} more, on the card"
        sentences.append(f"The presses determine {values_text}.")
    if unidentified:
        meanings = [quantity.meaning.removesuffix(", %").removesuffix(RELATIVE) for quantity in unidentified]
        sentences.append(
            f"These presses do not determine {', '.join(meanings)}; their values are hardly more certain than before "
            "the presses."
        )

    # The charge of a press can be known although the single parameters in it are not.
    unidentified_parameters = [quantity.name for quantity in unidentified if quantity.name in SINGLE_PARAMETERS]
    response = table["response_percent"]
    if len(unidentified_parameters) > 1 and response.identified:
        names = ", ".join(name.removesuffix("_percent") for name in unidentified_parameters)
        sentences.append(
            f"{names}: only their combination, the charge of a press, is known to {response.std:.2g} %, which is what "
            "contacts need."
        )
    return tuple(sentences)
