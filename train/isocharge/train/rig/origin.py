"""What a model was fitted to, in words: the section of its card about the presses, the film and the correction."""

from collections.abc import Iterator

import numpy as np

from isocharge.common.arrays import Booleans
from isocharge.serve.prediction.measured_presses import MeasuredPresses
from isocharge.train.rig.rig_film import RigFilm


def origin_section(film: RigFilm, presses: MeasuredPresses, held: Booleans, held_file: str) -> str:
    """Markdown for the card.

    Args:
        film: What the presses show.
        presses: All of them.
        held: Those that errors are measured on, shape (n,).
        held_file: Name of their file.
    """
    rows = "\n".join(f"- {sentence}" for sentence in _sentences(film, presses, held, held_file))
    return f"## Fitted to measured presses\n\n{rows}\n\n"


def _sentences(film: RigFilm, presses: MeasuredPresses, held: Booleans, held_file: str) -> Iterator[str]:
    yield (
        f"{(~held).sum()} measured presses of one film; {held.sum()} others are in `{held_file}`: they were held out, "
        "and the errors below are of them."
    )
    yield (
        f"The rig knows places to {np.median(presses.position_std_mm):.3g} mm and forces to "
        f"{100.0 * np.median(presses.force_std):.3g} %, as given."
    )
    if film.calibration is None:
        yield (
            "The film was not calibrated, for no network for all films fits its layout and probe: the presses correct "
            "the sensor as described. Where they are far apart the film may differ from both."
        )
    else:
        yield from film.calibration.words
    yield _correction(film, presses)
    if film.scattered:
        yield (
            f"The presses scatter about the corrected map by {film.scatter:.2g} times what noise and rig explain: more "
            "noise than assumed, or a film that the correction follows only roughly."
        )


def _correction(film: RigFilm, presses: MeasuredPresses) -> str:
    correction = film.correction
    if correction.nothing:
        return "No correction beyond the film's physics: it would predict presses left out in turn no better."
    low, high = correction.force_range_N
    return (
        f"Beyond the film's physics the charges are corrected by {film.correction_percent(presses.contact):.2g} % "
        f"(root mean square), by polynomials of degree {correction.degree} in place and logarithm of the force. "
        f"Farther than {correction.radius_mm:.3g} mm from the centre, and outside {low:.3g} to {high:.3g} N, no press "
        "was made: the correction stays as at the nearest press."
    )
