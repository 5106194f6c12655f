"""Selection of the presses of a dataset on which a released model can be evaluated.

A model can only be evaluated on presses of its own sensor, within the working area and the forces of its training.
"""

from dataclasses import replace

import numpy as np

from isocharge.common.arrays import Booleans
from isocharge.common.errors import ModelError
from isocharge.serve import ModelMetadata
from isocharge.simulate import Dataset, Samples
from isocharge.simulate.sensor.sensor_file import sensor_to_dict
from isocharge.train.data.presses import LabelledPresses, check_enough, domain_of
from isocharge.train.model_release.release import model_domain

RANGE_TOLERANCE = 1.0 + 1e-6
"""Factor by which a force or a radius may exceed the range of a model because of rounding."""


def select_presses(dataset: Dataset, is_selected: Booleans) -> Dataset:
    """Return the dataset with some of its presses.

    Args:
        dataset: The dataset.
        is_selected: Whether to keep each press, shape (n_press,).
    """
    columns = dataset.samples.columns()
    selected_columns = {name: values[is_selected] for name, values in columns.items()}
    return replace(dataset, samples=Samples(**selected_columns))


def simulated_presses_for(model: ModelMetadata, dataset: Dataset) -> Dataset:
    """Return the presses of a simulated dataset that lie in the working area of a model.

    Args:
        model: Metadata of the model.
        dataset: The simulated dataset. Its working area may be larger than the working area of the model.

    Raises:
        ModelError: If the model was trained for another sensor or for a smaller range of forces.
    """
    _check_same_sensor(model, dataset)
    domain = domain_of(dataset)
    min_force, max_force = domain.force_range
    model_min_force, model_max_force = model.force_range_N
    if min_force * RANGE_TOLERANCE < model_min_force or max_force > model_max_force * RANGE_TOLERANCE:
        raise ModelError(
            f"model {model.label}: expected forces from {model_min_force:g} to {model_max_force:g} N, for which the "
            f"model was trained, got a dataset with forces from {min_force:.4g} to {max_force:.4g} N; simulate a "
            "dataset within the range of the model, or train another model"
        )
    model_radius = model_domain(model).radius
    if domain.radius <= model_radius * RANGE_TOLERANCE:
        return dataset
    is_inside = np.hypot(dataset.samples.x_mm, dataset.samples.y_mm) <= model_radius
    ranges = {**dataset.manifest.get("ranges", {}), "radius_mm": model_radius}
    return replace(select_presses(dataset, is_inside), manifest={**dataset.manifest, "ranges": ranges})


def _check_same_sensor(model: ModelMetadata, dataset: Dataset) -> None:
    """Raise an error if a model was trained for another sensor than the sensor of a dataset.

    The names of the two sensors may differ.

    Args:
        model: Metadata of the model.
        dataset: The dataset.
    """
    expected = sensor_to_dict(dataset.sensor)
    given = dict(model.sensor)
    keys = (expected.keys() | given.keys()) - {"name"}
    different_keys = sorted(key for key in keys if expected.get(key) != given.get(key))
    if different_keys:
        raise ModelError(
            f"model {model.label}: expected a model of the dataset's sensor {expected['name']!r}, got a model of "
            f"{given.get('name')!r} with another {', '.join(different_keys)}; choose a model of this sensor with "
            "--model, or train one"
        )


def measured_presses_for(model: ModelMetadata, dataset: Dataset) -> Dataset:
    """Return the measured presses that lie within the working area and the forces of a model.

    Args:
        model: Metadata of the model.
        dataset: The measured presses.

    Raises:
        ModelError: If the electrodes of the model have other names.
        PressError: If too few presses remain.
    """
    if model.electrodes != dataset.sensor.electrode_names:
        raise ModelError(
            f"model {model.label}: expected the electrodes {dataset.sensor.electrode_names} of the presses, got "
            f"{model.electrodes}; choose a model of this sensor with --model, or train one"
        )
    presses = LabelledPresses.of(dataset)
    is_inside = model_domain(model).contains(presses.contact)
    check_enough(int(is_inside.sum()), len(presses), dataset.sensor.name)
    return replace(select_presses(dataset, is_inside), manifest={})
