"""Release of a network as a model folder, and the meaning of the outputs of released models."""

import json
import re
import shlex
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, halfnorm
from shared import whitened_errors

from isocharge.common.errors import ConfigError
from isocharge.common.structs import convert
from isocharge.serve import Predictor, find_model
from isocharge.serve.model.metadata import ModelNoise
from isocharge.serve.model.model_folder import model_names
from isocharge.simulate import Circle, Domain, ForwardMap, noise_model, press
from isocharge.simulate.sensor.sensor_file import sensor_from_dict
from isocharge.simulate.solver.equilibrium import principal_stress
from isocharge.train import (
    FitConfig,
    LabelledPresses,
    evaluate,
    load_config,
    release,
)
from isocharge.train.data.presses import draw_contacts
from isocharge.train.model_release import release as release_module
from isocharge.train.model_release.evaluate import simulated_errors
from kept import ROOT, kept

PROBE = Circle(1.0)
REFERENCE = noise_model("reference")
MODELS = ROOT / "models"
FORCE_RANGE_N = (0.05, 2.0)
RADIUS_mm = 8.0
LARGEST_RADIUS_mm = 15.001

LARGEST_ERRORS = {
    "three-25um-biaxial-12mm": (0.14, 0.25, 0.18, 0.8),  # and in a large area
    "six-25um-biaxial-30mm": (0.16, 0.43, 0.18, 1.2),  # most of the film
    "eight-25um-biaxial-36mm": (0.15, 0.34, 0.22, 1.2),
}
"""Largest errors of models: median and rms of the position error, its 95th percentile without noise, mm, and the rms
error of the force, %."""

ELLIPSE_TOLERANCES = {
    "four-25um-biaxial": 0.03,  # the map nearly folds at the edge of the area
    "eight-25um-biaxial-36mm": 0.035,  # near the clamp, the ellipses contain 70 % of 60,000 contacts
    "four-25um-biaxial-student": 0.09,  # small networks have larger errors
    "three-25um-biaxial-student": 0.04,
}
"""Largest difference from 0.68 of the coverage of the 68 % ellipses of models whose errors are not quite Gaussian."""


@pytest.fixture(scope="module")
def released(fitted, tmp_path_factory):
    return release(fitted, str(tmp_path_factory.mktemp("models") / "mine"), command="make it")


def _slow_if_solved(name):
    """Mark models whose film or area is not simulated by other tests as slow."""
    if name.endswith("mm") or name.startswith(("eight", "four-25um-biaxial")):  # beyond 8 mm
        return pytest.param(name, marks=pytest.mark.slow)
    return name


@pytest.fixture(scope="module", params=map(_slow_if_solved, model_names(MODELS)))
def predictor(request):
    """Each released model."""
    return Predictor(find_model(MODELS / request.param))


@pytest.mark.parametrize(
    "name",
    [
        "three-25um-biaxial",
        "four-25um-biaxial",
        "four-25um-biaxial-15mm",
        "eight-25um-biaxial",
        "six-25um-biaxial-30mm",
        "eight-25um-biaxial-36mm",
    ],
)
def test_command_of_a_card_trains_with_the_settings_of_its_model(name):
    """The other models were trained by an earlier version, most of whose settings do not exist any more."""
    model = find_model(MODELS / name)
    card = (model / "card.md").read_text("utf-8")
    words = shlex.split(re.search(r"```bash\n(.*)\n```", card)[1])
    config = FitConfig()
    if "--config" in words:
        config = load_config(MODELS.parent / words[words.index("--config") + 1])

    metadata = Predictor(model).metadata
    n_electrode = len(metadata.electrodes)
    recorded = metadata.made_with["config"]
    removed_keys = {"patience", "electrodes", "activation"}
    kept_settings = {
        table: {key: value for key, value in recorded[table].items() if key not in removed_keys} for table in recorded
    }
    recorded_config = convert(kept_settings, FitConfig, "", ConfigError)
    assert config.for_electrodes(n_electrode) == recorded_config.for_electrodes(n_electrode)


@pytest.fixture(scope="module")
def forward_map(predictor, film):
    """The simulated map of the model's sensor, and the radius of its area, mm."""
    area = np.array(predictor.metadata.working_area_mm)
    radius = np.cos(np.pi / len(area)) * np.hypot(*area[0])
    sensor = sensor_from_dict(dict(predictor.metadata.sensor))
    if sensor.film != film.sensor.film:
        return ForwardMap.build(sensor, PROBE, radius), radius
    film_map = film if radius <= RADIUS_mm else kept(ForwardMap.build, film.sensor, PROBE, radius=LARGEST_RADIUS_mm)
    return replace(film_map, sensor=sensor), radius


@pytest.fixture(scope="module")
def truth(forward_map):
    """Contacts that were not in the training, and their simulated charges."""
    film, radius = forward_map
    return kept(draw_presses, film, radius)


def draw_presses(film, radius):
    """Draw contacts that were not in the training, and simulate their charges."""
    contact = draw_contacts(np.random.default_rng(78), Domain(radius, FORCE_RANGE_N), 10_000)
    return LabelledPresses(contact, film.charges(contact))


def answers(predictor, charge):
    """Return the contacts, standard deviations, misfits and correlations that a model states."""
    columns = np.stack(predictor.predict_batch(charge), axis=1).astype(float)
    return np.split(columns, [3, 6, 7], axis=1)


def test_the_folder_is_complete_and_its_card_and_metadata_agree(released, dataset, sensor):
    assert sorted(path.name for path in released.folder.iterdir()) == ["card.md", "golden.json", "model.onnx"]
    assert (released.folder.parent / "config.pbtxt").is_file()
    metadata = Predictor(released.folder).metadata
    assert metadata == released.metadata
    assert (metadata.electrodes, metadata.probes) == (("A", "B", "C"), ("circle:1.0",))
    assert (metadata.dataset_sha256, metadata.force_range_N) == (dataset.sha256, FORCE_RANGE_N)
    press_at_yield = press(sensor.film, PROBE, (0.0, 0.0), metadata.yield_force_N)
    assert principal_stress(press_at_yield)[1] == pytest.approx(45.0, rel=0.01)
    assert metadata.noise == ModelNoise(name="reference", white_pC=1.0, gain=0.002)
    assert sensor_from_dict(json.loads(json.dumps(metadata.sensor))) == sensor
    corners = np.array(metadata.working_area_mm)
    edge_centres = 0.5 * (corners + np.roll(corners, -1, axis=0))
    assert np.hypot(*edge_centres.T).min() == pytest.approx(RADIUS_mm, abs=1e-3)
    card = (released.folder / "card.md").read_text()
    assert f"{metadata.errors['position_median_mm']:g} mm" in card
    assert "| noise `reference` | 1 pC and 0.2 % |" in card
    assert "Three charges nearly always fit some contact." in card
    assert f"beyond {metadata.yield_force_N:g} N at the centre, the stress exceeds 45 MPa" in card
    percentages = re.findall(r"\| (?:coverage|detected).* \| (\S+)% \|", card)
    names = ["coverage_68", "coverage_95", "found_gain_20_percent", "found_dead_electrode"]
    expected_fractions = [metadata.errors[name] for name in names]
    np.testing.assert_allclose(np.array(percentages, float) / 100.0, expected_fractions, atol=6e-4)


@pytest.mark.parametrize(("misfit", "warnings"), [(5.3, 0), (11.9, 1)])
def test_probes_whose_differences_hide_faults_cause_a_warning(fitted, tmp_path, monkeypatch, caplog, misfit, warnings):
    errors = {**evaluate(fitted), "misfit_p999": misfit}
    monkeypatch.setattr(release_module, "evaluate", lambda _: errors)
    release(fitted, tmp_path / "mine")
    assert caplog.text.count(f"misfit above {misfit}") == warnings


def test_the_errors_in_the_metadata_are_those_of_the_served_model(fitted, released):
    errors = evaluate(fitted)
    assert released.metadata.errors == errors
    noisy = fitted.test.noisy(REFERENCE, seed=1)
    contact = answers(Predictor(released.folder), noisy)[0]
    position_error = np.hypot(*(contact - fitted.test.contact)[:, :2].T)
    force_percent = 100.0 * np.abs(contact[:, 2] / fitted.test.contact[:, 2] - 1.0)
    assert errors["position_rms_mm"] == pytest.approx(np.sqrt(np.mean(position_error**2)), rel=1e-3)
    assert errors["force_p99_percent"] == pytest.approx(np.percentile(force_percent, 99), rel=1e-3)


def test_the_stated_errors_are_those_on_other_presses_and_small_enough(truth, predictor):
    errors = simulated_errors(lambda charge: answers(predictor, charge)[:3], truth[:6000], REFERENCE)
    for name in ("position_median_mm", "position_rms_mm", "force_rms_percent", "misfit_p99"):
        absolute_tolerance = 0.02 if name == "misfit_p99" else 0.0
        assert errors[name] == pytest.approx(predictor.metadata.errors[name], rel=0.15, abs=absolute_tolerance)
    largest_errors = LARGEST_ERRORS.get(predictor.metadata.name, (0.10, 0.20, 0.18, 0.8))
    names = ("position_median_mm", "position_rms_mm", "clean_position_p95_mm", "force_rms_percent")
    for name, largest_error in zip(names, largest_errors, strict=True):
        assert errors[name] <= largest_error
    if len(predictor.metadata.electrodes) == 4:
        assert errors["found_gain_20_percent"] >= 0.9
        assert errors["found_dead_electrode"] >= 0.99


@pytest.fixture(scope="module")
def whitened(truth, predictor):
    """Contacts, and their errors whitened by the stated covariance, which should be independent standard normal."""
    rows = truth[np.arange(30_000) % len(truth)]
    contact, std, _, correlation = answers(predictor, rows.noisy(REFERENCE, seed=8))
    truth = rows.contact.copy()
    truth[:, 2] = contact[:, 2] * (1.0 + np.log(rows.contact[:, 2] / contact[:, 2]))  # the error of ln F
    return rows.contact, whitened_errors(contact, truth, std, correlation)


def test_ellipses_and_ellipsoids_contain_the_stated_fraction_of_the_contacts(whitened, predictor):
    """For ellipses of the position and ellipsoids with the force, in each third by radius and by force."""
    contact, errors = whitened
    tolerance = ELLIPSE_TOLERANCES.get(predictor.metadata.name, 0.026)
    for key in (np.hypot(*contact[:, :2].T), contact[:, 2]):
        for rows in np.array_split(np.argsort(key), 3):
            for dimensions in (2, 3):
                level = chi2.cdf(np.sum(errors[rows, :dimensions] ** 2, axis=1), dimensions)
                assert np.mean(level < 0.68) == pytest.approx(0.68, abs=tolerance)
                assert np.mean(level < 0.95) == pytest.approx(0.95, abs=0.02)


def test_the_misfit_of_four_electrodes_is_half_normal(forward_map, truth, predictor):
    """Four charges determine three unknowns, so the misfit is the absolute value of one normal deviate."""
    if len(predictor.metadata.electrodes) != 4:
        pytest.skip("three charges always fit some contact")
    _, radius = forward_map
    charge = truth.within(0.9 * radius).noisy(REFERENCE, seed=3)
    misfit = predictor.predict_batch(charge).misfit
    tolerance = 0.4 if predictor.metadata.name.endswith("-student") else 0.15
    for probability in (0.5, 0.9, 0.95, 0.99):
        assert np.quantile(misfit, probability) == pytest.approx(halfnorm.ppf(probability), rel=tolerance)
