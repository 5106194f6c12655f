"""Release of a network for all films as a model folder with measured errors and a card."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.contact_errors import position_error
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.simulate import Sweep
from isocharge.simulate.dataset.sweep import outside_samples
from isocharge.simulate.solver.stress_limit import yield_force
from isocharge.train.data.outside_presses import OutsidePresses
from isocharge.train.data.presses import LabelledPresses, draw_contacts
from isocharge.train.films.films_file import FILE, films_bytes, films_from_bytes
from isocharge.train.films.films_model import FilmsModel
from isocharge.train.model_release.evaluate import ONLY_SIMULATED, contact_errors, rounded
from isocharge.train.model_release.release import Release, release, yield_text
from isocharge.train.model_release.unnoticed import unnoticed_section
from isocharge.train.training.fitted import Fitted, Provenance

N_FILMS = 64
"""Number of new films on which the errors are measured."""

N_PRESSES = 256
"""Number of presses on each new film on which the errors are measured."""

SEED = 90_001
"""Seed of the new films and of the presses on them. No training uses this seed."""

ROWS = (
    ("position, median", "position_median_mm", "mm"),
    ("position, rms", "position_rms_mm", "mm"),
    ("position, 95 %", "position_p95_mm", "mm"),
    ("position, rms of the median film", "position_rms_median_film_mm", "mm"),
    ("position, rms of the worst film", "position_rms_worst_film_mm", "mm"),
    ("force, median", "force_median_percent", "%"),
    ("force, rms", "force_rms_percent", "%"),
)
"""Rows of the table of errors in the card, each with a text, the name of the error, and its unit."""


@dataclass(frozen=True)
class FilmsErrors:
    """Errors of a network on new films of a prior, and the film that its model assumes before a calibration.

    Attributes:
        with_known_film: Errors if the parameters of each film are known.
        with_assumed_film: Errors on the same films if the network of the assumed film is used for each of them.
        parameters: Parameters of the assumed film, shape (n_parameter,). The assumed film is the described film or the
            mean of the prior, whichever gives the smaller errors.
        description: Text that names the assumed film, and states the errors with the described film and with the mean
            of the prior.
    """

    with_known_film: Mapping[str, float]
    with_assumed_film: Mapping[str, float]
    parameters: Array
    description: str


def evaluate_films(films: FilmsModel, n_film: int = N_FILMS, n_press: int = N_PRESSES, seed: int = SEED) -> FilmsErrors:
    """Measure the errors of a network for all films on new films, which are drawn from the prior.

    The same presses are evaluated twice. The first evaluation computes a network from the true parameters of each film.
    The second evaluation uses the network of one assumed film for all films. The assumed film is either the described
    film or the mean of the prior, whichever gives the smaller rms position error.

    The errors are position errors in mm and relative force errors in percent over all presses. They also include the
    rms position errors on the median film and on the worst film. The coverage of the 68 or 95 % intervals is the
    fraction of coordinates, 0 to 1, that lie in their interval.

    Args:
        films: The network.
        n_film: Number of films.
        n_press: Number of presses on each film.
        seed: Seed of films, presses and noise.

    Returns:
        The errors of both evaluations, and the parameters and the description of the assumed film.
    """
    rng = np.random.default_rng(seed)
    true_films = films.prior.draw(rng, n_film)
    true_contact, noisy_charge = _draw_presses(films, true_films, n_press, rng)
    errors_with_known_film = _errors_with_networks(films, true_films, true_contact, noisy_charge)

    # Measure the errors with each candidate for the assumed film.
    candidate_films = {"as described": films.prior.described, "in the middle of all": films.prior.mean}
    candidate_errors = {}
    for name, film in candidate_films.items():
        network_films = np.tile(film, (n_film, 1))  # the same film for all presses
        candidate_errors[name] = _errors_with_networks(films, network_films, true_contact, noisy_charge)
    rms_mm = {name: errors["position_rms_mm"] for name, errors in candidate_errors.items()}
    best_name, other_name = sorted(rms_mm, key=lambda name: rms_mm[name])  # the name with the smaller error first
    assumed_film = candidate_films[best_name]
    pretension_MPa = assumed_film[films.prior.index("pretension")]
    description = (
        f"the film {best_name}, with a pretension of {pretension_MPa:g} MPa.\nThe error over all films is then "
        f"{rms_mm[best_name]:g} mm rms (with the film {other_name}: {rms_mm[other_name]:g} mm)"
    )
    return FilmsErrors(errors_with_known_film, candidate_errors[best_name], assumed_film, description)


def _errors_with_networks(
    films: FilmsModel, network_films: Array, true_contact: Array, noisy_charge: Array
) -> Mapping[str, float]:
    """Estimate contacts with the networks of given films, and compute the errors of the estimates.

    The films of the networks can differ from the films on which the presses were made.

    Args:
        films: The network for all films.
        network_films: Parameters of the films whose networks are used, shape (n_film, n_parameter).
        true_contact: Contacts on each film, shape (n_film, n_press, 3), mm and N.
        noisy_charge: Charges of these contacts, shape (n_film, n_press, n_electrode), pC.

    Returns:
        Statistics of the errors by name.
    """
    contacts = []
    stds = []
    for network_film, film_charge in zip(network_films, noisy_charge, strict=True):
        contact, std, _ = films.fold(network_film).predict(film_charge)
        contacts.append(contact)
        stds.append(std)
    return _error_statistics(np.stack(contacts), np.stack(stds), true_contact)


def _draw_presses(films: FilmsModel, true_films: Array, n_press: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Draw presses on several films, and add noise to their charges.

    Args:
        films: The network, which contains the forward maps, the domain and the noise.
        true_films: Parameters of the films, shape (n_film, n_parameter).
        n_press: Number of presses on each film.
        rng: Random number generator.

    Returns:
        Contacts (x, y, F), shape (n_film, n_press, 3), mm and N. Charges, shape (n_film, n_press, n_electrode), pC.
    """
    contacts = []
    noisy_charges = []
    for parameters in true_films:
        contact = draw_contacts(rng, films.domain, n_press)
        charge = films.forward_map(parameters).charges(contact)
        contacts.append(contact)
        noisy_charges.append(films.noise.add(charge, rng))
    return np.stack(contacts), np.stack(noisy_charges)


def _error_statistics(contact: Array, std: Array, truth: Array) -> Mapping[str, float]:
    """Compute error statistics of contacts that were estimated on several films.

    Args:
        contact: Estimated contacts (x, y, F), shape (n_film, n_press, 3), mm and N.
        std: Reported standard deviations, same shape.
        truth: True contacts, same shape.

    Returns:
        Statistics over all presses, and the rms position errors of the median film and of the worst film, by name.
    """
    all_contacts = contact.reshape(-1, 3)
    all_truth = truth.reshape(-1, 3)
    errors = contact_errors(all_contacts, std.reshape(-1, 3), all_truth)
    statistics = {name: error for name, error in errors.items() if name not in ONLY_SIMULATED}  # no 99th percentiles

    position_errors = position_error(all_contacts, all_truth).reshape(truth.shape[:2])  # shape (n_film, n_press)
    film_rms = np.sqrt((position_errors**2).mean(axis=1))
    statistics["position_rms_median_film_mm"] = rounded(np.median(film_rms))
    statistics["position_rms_worst_film_mm"] = rounded(film_rms.max())
    return statistics


def release_films(films: FilmsModel, folder: Path, *, version: int = 1, command: str = "") -> Release:
    """Write a model folder with the network for all films (`films.npz`) and the model of the assumed film.

    The errors are measured with the rounded weights that the file contains. Presses outside the working area are
    simulated on the assumed film. The metadata state the share of these presses to which the model gives a wrong answer
    without a flag.

    Args:
        films: The trained network.
        folder: Folder of the model, `models/NAME`. Its name is the name of the model.
        version: Number of the version folder.
        command: Command that makes this model again, for the card.

    Returns:
        The version folder, and the metadata with the errors on the assumed film.

    Raises:
        OutputExists: If the version exists.
        TrainingError: If an exported graph and the network disagree.
    """
    data = films_bytes(films)
    rounded_films = films_from_bytes(data, FILE)
    errors = evaluate_films(rounded_films)
    made_with = {**films.made_with, "films": dict(errors.with_known_film)}
    provenance = Provenance(made_with=made_with, files={FILE: data})
    sensor, probe = rounded_films.prior.film(errors.parameters)
    assumed_film_model = rounded_films.film(errors.parameters, provenance=provenance)
    fitted = replace(
        assumed_film_model,
        outside=_outside_presses(rounded_films, errors.parameters, assumed_film_model.test),
        yield_force_N=yield_force(sensor.film, [probe], films.domain.force_range),
    )
    return release(fitted, folder, version=version, command=command, card=partial(films_card, rounded_films, errors))


def _outside_presses(films: FilmsModel, parameters: Array, presses: LabelledPresses) -> OutsidePresses | None:
    """Simulate presses on the part of a film that lies outside the working area.

    Args:
        films: The network for all films, with the prior of the films and the working area.
        parameters: Parameters of the film, shape (n_parameter,).
        presses: Presses within the working area.

    Returns:
        The presses; None if this part of the film cannot be simulated.
    """
    sensor, probe = films.prior.film(parameters)
    samples = outside_samples(sensor, [probe], Sweep(films.domain.radius, films.domain.force_range))
    if samples is None:
        return None
    return OutsidePresses.of(films.domain, presses, LabelledPresses.of_samples(samples, measured=False))


def films_card(films: FilmsModel, errors: FilmsErrors, about: ModelMetadata, fitted: Fitted) -> str:
    """Return the text of `card.md` for a model that contains a network for all films.

    Args:
        films: The network for all films.
        errors: Errors of the network on films drawn from the prior.
        about: Metadata of `model.onnx`.
        fitted: Network of the film that `model.onnx` assumes.
    """
    min_force, max_force = fitted.domain.force_range
    spread = films.prior.spread
    errors_if_known = errors.with_known_film
    errors_if_assumed = errors.with_assumed_film
    model_errors = about.errors  # of `model.onnx`, on the film that it assumes
    force_rms_percent = model_errors["force_rms_percent"]
    electrodes = ", ".join(about.electrodes)
    correlated = ", `contact_correlation` (xy, xF, yF)"
    outside_section = ""
    if about.unnoticed is not None:
        outside_section = (
            f"{unnoticed_section(about.unnoticed)}These shares hold for the film that `model.onnx` assumes.\n\n"
        )
    error_rows = [
        f"| {text} | {errors_if_known[key]:g} {unit} | {errors_if_assumed[key]:g} {unit} |" for text, key, unit in ROWS
    ]
    error_rows += [
        f"| coverage of the {level} % intervals | {100 * errors_if_known[f'coverage_{level}']:.3g} % | "
        f"{100 * errors_if_assumed[f'coverage_{level}']:.3g} % |"
        for level in (68, 95)
    ]
    return f"""# {about.name}, version {about.version}

A network for every film that the sensor `{about.sensor["name"]}` may be. The file `films.npz` holds it. From the
parameters of a film, it computes a model of that film in under a second. `isocharge train calibrate` estimates these
parameters from a few presses on a real film.

`model.onnx` is the model of {errors.description}.
It can be used before a calibration; its errors are then those of the right column.

| | |
|---|---|
| input | `charge_pC`, float32 [n, {len(about.electrodes)}], touch charges of {electrodes} in pC |
| outputs | `contact` (x_mm, y_mm, force_N), `contact_std` (one standard deviation of each){correlated}, `misfit` |
| working area | within {fitted.domain.radius:g} mm of the centre |
| forces | {min_force:g} to {max_force:g} N{yield_text(about)} |
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

## Errors on 64 films with 256 presses each, which were not used in the training

The forces are log-uniform, the positions are uniform over the working area, and the noise is the one named above.

| error | the film is known | `model.onnx`, the film is unknown |
|---|---|---|
{chr(10).join(error_rows)}

On the film that it assumes, `model.onnx` has an error of {model_errors["position_rms_mm"]:g} mm rms (median
{model_errors["position_median_mm"]:g} mm) and {force_rms_percent:g} % of the force. 1 % of the good presses of that
film have a misfit above {model_errors["misfit_p99"]:g}, and 0.1 % above {model_errors["misfit_p999"]:g}.

{outside_section}## Limits

- These figures compare with the simulator. It does not simulate films that wrinkle, creep or are not uniform.
- On films with a large pretension, different contacts near the edge of the working area can have the same charges. No
  model can tell such contacts apart. These are the worst films above.
- The model assumes one press at a time. Outside the working area and the range of forces, the answer is finite and
  wrong. The misfit is then large in many cases, but not in all.

## Make it again

```bash
{about.made_with.get("command") or "(made by a program, see metadata)"}
```
"""
