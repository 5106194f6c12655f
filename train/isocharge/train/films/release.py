"""The network for all films as a model: its errors, its card, its folder."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.train.data.presses import draw_contacts, position_error
from isocharge.train.films.films_file import FILE, films_bytes, films_from_bytes
from isocharge.train.films.films_model import FilmsModel
from isocharge.train.model_release.evaluate import ONLY_SIMULATED, contact_errors, rounded
from isocharge.train.model_release.release import Release, release, yield_text
from isocharge.train.training.fitted import Fitted, Provenance

FILMS, PRESSES = 64, 256
"""Fresh films that errors are measured on, and presses of each."""

SEED = 90_001
"""Of the fresh films: no training draws with it."""

ROWS = (
    ("position, median", "position_median_mm", "mm"),
    ("position, rms", "position_rms_mm", "mm"),
    ("position, 95 %", "position_p95_mm", "mm"),
    ("position, rms of the median film", "position_rms_median_film_mm", "mm"),
    ("position, rms of the worst film", "position_rms_worst_film_mm", "mm"),
    ("force, median", "force_median_percent", "%"),
    ("force, rms", "force_rms_percent", "%"),
)
"""Lines of the table of errors: text, key, unit."""


@dataclass(frozen=True)
class FilmsErrors:
    """Errors on fresh films of a prior, and the film that a model assumes before anything is calibrated.

    Attributes:
        known: Errors if the network knows each film.
        unknown: Errors on the same films if it takes all of them for the assumed one.
        parameters: Of the assumed film, shape (n_parameter,): that with the lower error of the described one and the
            mean of the prior.
        description: The assumed film in words, with the errors of both.
    """

    known: Mapping[str, float]
    unknown: Mapping[str, float]
    parameters: Array
    description: str


def evaluate_films(films: FilmsModel, count: int = FILMS, presses: int = PRESSES, seed: int = SEED) -> FilmsErrors:
    """Errors over films drawn from the prior, with presses that no training saw.

    Position errors in mm and relative force errors in percent over all presses, the rms of the median film and of the
    worst, and the coverage of the 68 and 95 % intervals (share of coordinates, 0 to 1).

    Args:
        films: The network.
        count: Number of films.
        presses: Presses on each.
        seed: Of films, presses and noise.
    """
    rng = np.random.default_rng(seed)
    parameters = films.prior.draw(rng, count)
    contacts, noisy = [], []
    for film in parameters:
        contacts.append(draw_contacts(rng, films.domain, presses))
        noisy.append(films.noise.add(films.forward_map(film).charges(contacts[-1]), rng))
    truth = np.stack(contacts)

    def errors(assumed: Array) -> Mapping[str, float]:
        answers = [films.fold(film).predict(charge) for film, charge in zip(assumed, noisy, strict=True)]
        return _errors(np.stack([answer[0] for answer in answers]), np.stack([answer[1] for answer in answers]), truth)

    choices = {"as described": films.prior.described, "in the middle of all": films.prior.mean}
    tried = {name: errors(np.tile(film, (count, 1))) for name, film in choices.items()}
    name, other = sorted(tried, key=lambda name: tried[name]["position_rms_mm"])
    description = (
        f"the film {name}, with a pretension of {choices[name][0]:g} MPa.\nThat film errs least over all films "
        f"({tried[name]['position_rms_mm']:g} mm rms; {other}: {tried[other]['position_rms_mm']:g} mm)"
    )
    return FilmsErrors(errors(parameters), tried[name], choices[name], description)


def _errors(contact: Array, std: Array, truth: Array) -> Mapping[str, float]:
    """Errors of contacts, all of shape (n_film, n_press, 3)."""
    flat = contact.reshape(-1, 3), std.reshape(-1, 3), truth.reshape(-1, 3)
    position = position_error(flat[0], flat[2]).reshape(truth.shape[:2])
    by_film = np.sqrt((position**2).mean(axis=1))
    every = contact_errors(*flat)
    return {
        **{name: error for name, error in every.items() if name not in ONLY_SIMULATED},
        "position_rms_median_film_mm": rounded(np.median(by_film)),
        "position_rms_worst_film_mm": rounded(by_film.max()),
    }


def release_films(films: FilmsModel, folder: Path, *, version: int = 1, command: str = "") -> Release:
    """Write a network for all films as a model: `films.npz`, and the plain model of the film that errs least over all.

    Args:
        films: What `fit_films` gives.
        folder: The model's folder, `models/NAME`; the name is the model's.
        version: Number of the version folder.
        command: How to make this model again, for the card.

    Returns:
        Where it is; the errors of its metadata are those on the film that it assumes.

    Raises:
        OutputExists: If the version exists.
        TrainingError: If an exported file and the network disagree.
    """
    data = films_bytes(films)
    as_written = films_from_bytes(data, FILE)
    errors = evaluate_films(as_written)
    provenance = Provenance(made_with={**films.made_with, "films": dict(errors.known)}, files={FILE: data})
    fitted = as_written.film(errors.parameters, provenance=provenance)
    return release(fitted, folder, version=version, command=command, card=partial(films_card, as_written, errors))


def films_card(films: FilmsModel, errors: FilmsErrors, about: ModelMetadata, fitted: Fitted) -> str:
    """The text of `card.md`."""
    (low, high), spread = fitted.domain.force_range, films.prior.spread
    known, unknown, exact = errors.known, errors.unknown, about.errors
    electrodes, correlated = ", ".join(about.electrodes), ", `contact_correlation` (xy, xF, yF)"
    lines = [f"| {text} | {known[key]:g} {unit} | {unknown[key]:g} {unit} |" for text, key, unit in ROWS]
    lines += [
        f"| coverage of the {level} % intervals | {100 * known[f'coverage_{level}']:.3g} % | "
        f"{100 * unknown[f'coverage_{level}']:.3g} % |"
        for level in (68, 95)
    ]
    return f"""# {about.name}, version {about.version}

A network for every film that the sensor `{about.sensor["name"]}` may be. `films.npz` holds it; told a film, it gives a
plain model of that film in under a second. `isocharge train calibrate` does that after a few presses on a real film.

`model.onnx` is that plain model for {errors.description}.
It serves before anything is calibrated, and errs as the right column says.

| | |
|---|---|
| input | `charge_pC`, float32 [n, {len(about.electrodes)}], touch charges of {electrodes} in pC |
| outputs | `contact` (x_mm, y_mm, force_N), `contact_std` (one standard deviation of each){correlated}, `misfit` |
| working area | within {fitted.domain.radius:g} mm of the centre |
| forces | {low:g} to {high:g} N{yield_text(about)} |
| probe | {about.probes[0]} as described |
| trained for the noise | {films.noise.name}: {films.noise.white:g} pC and {100 * films.noise.gain:g} % |

## The films

| | one standard deviation |
|---|---|
| pretension | anything from 0 to {spread.pretension:g} MPa |
| Young's modulus; thickness | {100 * spread.young:g} %; {100 * spread.thickness:g} % |
| d31 and d32, each; gains, each | {100 * spread.d31:g} %; {100 * spread.gain:g} % |
| shift along x and y, each; rotation | {spread.shift:g} mm; {np.rad2deg(spread.rotation):.3g} degrees |
| probe radius | {films.prior.std[films.prior.names.index("probe_radius")]:g} mm |

## Measured on 64 films and 256 presses of each, none of them in the training

Forces log-uniform, positions uniform over the working area, noise as above.

| error | told the film | `model.onnx`, not told |
|---|---|---|
{chr(10).join(lines)}

On the very film that it assumes, `model.onnx` errs by {exact["position_rms_mm"]:g} mm rms (median
{exact["position_median_mm"]:g} mm) and {exact["force_rms_percent"]:g} % of the force. 1 % of good presses of that film
exceed a misfit of {exact["misfit_p99"]:g}, 0.1 % one of {exact["misfit_p999"]:g}.

## Limits

- The truth behind these figures is the simulator. A film that wrinkles, creeps or is not uniform is none of these.
- The tauter a film, the nearer to the centre its charges stop telling the place: the worst films above. A map that
  folds within the working area cannot be turned back there by any model.
- One press at a time. Outside the working area and forces the answer is finite and wrong; the misfit is then large in
  many cases, not in all.

## Make it again

```bash
{about.made_with.get("command") or "(made by a program, see metadata)"}
```
"""
