"""How wrong a model is on measured presses: its errors, the part that noise and rig explain, and a verdict.

The model's standard deviations say how far noise of the charges moves an answer, the file how well the rig knows place
and force. If the errors are larger than both together, the film is not the model's: it has aged, its pretension has
crept, or it was never calibrated. Such drift shows first as a common scale of the forces and a common shift.
"""

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from isocharge.common.arrays import Booleans
from isocharge.common.json_values import plain_values
from isocharge.serve.flags import MISFIT
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.prediction.contact import Validity
from isocharge.serve.prediction.measured_presses import MeasuredPresses, row_words
from isocharge.serve.prediction.predictor import Predictor
from isocharge.serve.prediction.press_errors import (
    NOT_TRAINED,
    Agreement,
    ErrorSummary,
    PressErrors,
    chi_squared_survival,
    misfit_limit,
    press_errors,
)

FEWEST = 3
"""Presses below which nothing is said: one bad press among two cannot be told from a bad film."""

BAD_PROBABILITY = 1e-3
"""Probability that noise makes the worst of all presses look bad."""

BAD_SHARE = 0.1
"""Largest share of bad presses, at least one, that a film may have and still fit."""

MISFIT_SHARE, MISFIT_PROBABILITY = 0.01, 2e-3
"""Share of good presses with a misfit beyond the model's limit; probability below which more of them are too many."""

MOST_LISTED = 5
"""Largest number of presses that a note lists."""

ENOUGH_TO_FIT = 50
"""Presses from which `train fit` learns a model from them."""


@dataclass(frozen=True)
class PressCheck:
    """What measured presses say about a model.

    Attributes:
        model: `name/version`.
        presses, counted: Number of presses in the file, and of those that the figures below are about.
        position_mm, force_percent: Errors; None if no place, or no force, is known.
        agreement: Sum of squares and common part.
        fits: Whether noise explains the errors; None if there are too few presses to say.
        verdict: The answer in words.
        notes: What else a reader should know, a sentence each.
        errors: The presses one by one.
    """

    model: str
    presses: int
    counted: int
    position_mm: ErrorSummary | None
    force_percent: ErrorSummary | None
    agreement: Agreement
    fits: bool | None
    verdict: str
    notes: tuple[str, ...]
    errors: PressErrors

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON, names with units; None where something is unknown."""
        both, degrees = self.agreement, self.agreement.degrees
        values = {
            "model": self.model,
            "fits": self.fits,
            "verdict": self.verdict,
            "notes": self.notes,
            "presses": self.presses,
            "counted": self.counted,
            "position_mm": self.position_mm and asdict(self.position_mm),
            "force_percent": self.force_percent and asdict(self.force_percent),
            "chi_squared": both.chi_squared,
            "degrees_of_freedom": degrees,
            "chi_squared_per_degree": both.chi_squared / degrees if degrees else None,
            "p_value": both.p_value,
            "shift_mm": [both.shift_x.mean, both.shift_y.mean],
            "shift_std_mm": [both.shift_x.std, both.shift_y.std],
            "force_scale": 1.0 + both.force.mean,
            "force_scale_std": both.force.std,
            "common_p_value": both.common_p_value,
            "each": [self.errors.row(press) for press in range(self.presses)],
        }
        return {name: plain_values(value) for name, value in values.items()}


def check_presses(predictor: Predictor, presses: MeasuredPresses) -> PressCheck:
    """Compare a model with measured presses.

    A press counts if all its charges are known, its place or its force is known, and what is known lies in the model's
    working area and range of forces. A few bad presses are named and left out if all others agree with the model.

    Raises:
        PressError: If a charge of one of the model's electrodes is missing.
    """
    errors = press_errors(predictor, presses)
    rows, bad = _without_bad(errors)
    agreement, count = Agreement.of(errors, rows), int(rows.sum())
    position, force = _summaries(errors, rows)
    misfits = _too_many(errors, rows, predictor.metadata)
    fits = agreement.acceptable and not misfits if count >= FEWEST else None
    return PressCheck(
        model=predictor.metadata.label,
        presses=len(presses),
        counted=count,
        position_mm=position,
        force_percent=force,
        agreement=agreement,
        fits=fits,
        verdict=_verdict(fits, count, position, force, misfits),
        notes=(
            *(_remedies(predictor.metadata, position, force) if fits is False else ()),
            *_notes(errors, rows, bad, agreement, predictor.metadata),
        ),
        errors=errors,
    )


def _without_bad(errors: PressErrors) -> tuple[Booleans, Booleans]:
    """The rows to judge by, and the bad ones that were left out: only where all others then agree with the model."""
    counted = errors.counted
    if not Agreement.of(errors, counted).acceptable:
        bad = _bad(errors, counted)
        few = 0 < bad.sum() <= max(1.0, BAD_SHARE * counted.sum()) and counted.sum() - bad.sum() >= FEWEST
        if few and Agreement.of(errors, counted & ~bad).acceptable:
            return counted & ~bad, bad
    return counted, np.zeros_like(counted)


def _bad(errors: PressErrors, counted: Booleans) -> Booleans:
    """Presses that noise would hardly make, shape (n,)."""
    bad, limit = np.zeros_like(counted), BAD_PROBABILITY / max(1, counted.sum())
    squares = errors.error**2 / errors.variance
    for press in np.flatnonzero(counted & (np.nansum(squares, axis=1) > 9.0)):  # others are not worth the function
        known = squares[press][~np.isnan(squares[press])]
        bad[press] = chi_squared_survival(float(known.sum()), known.size) < limit
    return bad


def _summaries(errors: PressErrors, rows: Booleans) -> tuple[ErrorSummary | None, ErrorSummary | None]:
    """Of the positions, mm, and of the forces, %; None where none is known."""
    kinds = (errors.position_error_mm, slice(0, 2), 1.0), (np.abs(errors.error[:, 2]), slice(2, 3), 100.0)
    summaries = []
    for size, columns, unit in kinds:
        known = rows & ~np.isnan(size)
        noise, rig = (np.sum((unit * std[known, columns]) ** 2, axis=1) for std in (errors.noise_std, errors.rig_std))
        summaries.append(ErrorSummary.of(unit * size[known], noise, rig))
    return summaries[0], summaries[1]


def _too_many(errors: PressErrors, rows: Booleans, metadata: ModelMetadata) -> str:
    """How many of some presses have a misfit that few good ones have; empty if chance explains that."""
    flags = [flags for flags, chosen in zip(errors.flags, rows.tolist(), strict=True) if chosen]
    count, most = len(flags), sum(MISFIT in words for words in flags)
    ways = (math.lgamma(count + 1) - math.lgamma(k + 1) - math.lgamma(count - k + 1) for k in range(most))
    odds, none = math.log(MISFIT_SHARE / (1.0 - MISFIT_SHARE)), count * math.log1p(-MISFIT_SHARE)
    shares = (math.exp(way + k * odds + none) for k, way in enumerate(ways))  # the numbers overflow, not the product
    if 1.0 - sum(shares) >= MISFIT_PROBABILITY:
        return ""
    return f"{most} of {count} presses have a misfit above {misfit_limit(metadata):.3g}, which 1 % of good ones have"


def _verdict(
    fits: bool | None, count: int, position: ErrorSummary | None, force: ErrorSummary | None, misfits: str
) -> str:
    if fits is None:
        return f"too few presses to say: {count} can be compared, {FEWEST} are needed"
    if fits:
        return "fits: noise explains the errors"
    parts = [f"{position.beyond:.2g} mm"] if position else []
    parts += [f"{force.beyond:.2g} %"] if force else []
    return f"does not fit: {' and '.join(parts)} beyond noise" + (f"; {misfits}" if misfits else "")


def _remedies(metadata: ModelMetadata, position: ErrorSummary | None, force: ErrorSummary | None) -> Iterator[str]:
    """What would help, by what was done already."""
    stds = [f"--position-std {_rig(position) / 2**0.5:.2g}"] if position else []
    stds += [f"--force-std {0.01 * _rig(force):.2g}"] if force else []
    yield f"the errors would be the rig's if that were as uncertain as {' '.join(stds)}"
    calibration = metadata.sensor.get("calibration")
    if not (isinstance(calibration, dict) and any(calibration.get(key) for key in ("gain", "rotation_deg"))):
        yield "this model is of the film as described: calibrate it (isocharge train calibrate)"
        return
    yield (
        "this film is calibrated already: do so again only if it has changed since (isocharge train calibrate --from); "
        + f"what no film explains, `isocharge train fit PRESSES.csv` learns from {ENOUGH_TO_FIT} presses on"
    )


def _rig(errors: ErrorSummary) -> float:
    """What a rig would have to explain, in the unit of the errors."""
    return float(np.sqrt(max(errors.rms**2 - errors.noise**2, 0.0)))


def _notes(
    errors: PressErrors, rows: Booleans, bad: Booleans, agreement: Agreement, metadata: ModelMetadata
) -> Iterator[str]:
    """What else a reader should know."""
    for reason in sorted(set(filter(None, errors.left_out))):
        chosen = [line for line, other in zip(errors.lines, errors.left_out, strict=True) if other == reason]
        words = row_words(chosen, errors.row_noun, MOST_LISTED)
        yield f"{len(chosen)} of {len(rows)} presses do not count: {_explained(reason, metadata)} ({words})"
    if bad.any():
        words = row_words(np.array(errors.lines)[bad].tolist(), errors.row_noun, MOST_LISTED)
        yield f"{words}: nothing like the other presses, left out; look at it"
    if misfits := _too_many(errors, np.ones_like(rows), metadata):
        yield (
            f"{misfits}: no single press on the model's film gives such charges (gain, tare, swapped or dead electrode)"
        )
    yield from _common_notes(agreement)


def _explained(reason: str, metadata: ModelMetadata) -> str:
    if reason != NOT_TRAINED:
        return reason
    low, high = metadata.force_range_N
    validity = Validity.of(metadata)
    places = f"{validity.places} from the centre" if validity.is_centred else validity.places
    return (
        f"outside the model's working area ({places}) or forces ({low:.3g} to {high:.3g} N); if these are most, look "
        "at the units"
    )


def _common_notes(agreement: Agreement) -> Iterator[str]:
    """The common shift and scale, if noise does not explain them."""
    x, y, force = agreement.shift_x, agreement.shift_y, agreement.force
    if max(abs(x.significance), abs(y.significance)) > 3.0:
        yield (
            f"positions are off by ({x.mean:.2g}, {y.mean:.2g}) +- {max(x.std, y.std):.2g} mm on the average: "
            "electrodes or rig are shifted"
        )
    if abs(force.significance) > 3.0:
        yield (
            f"forces are {1.0 + force.mean:.4g} +- {force.std:.2g} times the known ones on the average, as after a "
            "change of pretension, d31 or gains"
        )
