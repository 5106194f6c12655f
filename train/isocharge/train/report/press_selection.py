"""Selection of the presses of a dataset on which a model can be evaluated.

A model can only be evaluated on presses of its own sensor, within the working area and the forces of its training.
"""

from dataclasses import replace

import numpy as np

from isocharge.common.arrays import Booleans
from isocharge.common.errors import ModelError
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.simulate import Dataset, Samples
from isocharge.simulate.sensor.sensor_file import sensor_to_dict
from isocharge.train.data.presses import LabelledPresses, check_enough, domain_of
from isocharge.train.model_release.release import model_domain

RANGE_TOLERANCE = 1.0 + 1e-6
"""Largest factor by which a force or a radius may exceed the range of a model because of rounding."""


def select_presses(dataset: Dataset, is_selected: Booleans) -> Dataset:
    """Return a dataset with only some of its presses.

    Args:
        dataset: The dataset.
        is_selected: Whether to keep each press, shape (n_press,).
    """
    columns = dataset.samples.columns()
    selected_columns = {name: values[is_selected] for name, values in columns.items()}
    return replace(dataset, samples=Samples(**selected_columns))


def simulated_presses_for(model: ModelMetadata, dataset: Dataset) -> Dataset:
    """Select from a simulated dataset the presses that lie in the working area of a model.

    If presses are excluded, the radius of the presses in the manifest of the dataset is reduced to the radius of the
    working area.

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
    is_below_range = min_force * RANGE_TOLERANCE < model_min_force
    is_above_range = max_force > model_max_force * RANGE_TOLERANCE
    if is_below_range or is_above_range:
        raise ModelError(
            f"model {model.label}: expected forces from {model_min_force:g} to {model_max_force:g} N, for which the "
            f"model was trained, got a dataset with forces from {min_force:.4g} to {max_force:.4g} N; simulate a "
            "dataset within the range of the model, or train another model"
        )

    model_radius = model_domain(model).radius
    lies_inside_model = domain.radius <= model_radius * RANGE_TOLERANCE
    if lies_inside_model:
        return dataset
    is_inside = np.hypot(dataset.samples.x_mm, dataset.samples.y_mm) <= model_radius
    selected_dataset = select_presses(dataset, is_inside)
    ranges = {**dataset.manifest.get("ranges", {}), "radius_mm": model_radius}
    return replace(selected_dataset, manifest={**dataset.manifest, "ranges": ranges})


def _check_same_sensor(model: ModelMetadata, dataset: Dataset) -> None:
    """Raise an error if a model was not trained for the sensor of a dataset.

    All values of the two sensors are compared, except their names, which may differ.

    Args:
        model: Metadata of the model.
        dataset: The dataset.

    Raises:
        ModelError: If the sensors differ. The message names the values that differ.
    """
    dataset_sensor = sensor_to_dict(dataset.sensor)
    model_sensor = dict(model.sensor)
    compared_keys = (dataset_sensor.keys() | model_sensor.keys()) - {"name"}
    different_keys = sorted(key for key in compared_keys if dataset_sensor.get(key) != model_sensor.get(key))
    if different_keys:
        raise ModelError(
            f"model {model.label}: expected a model of the dataset's sensor {dataset_sensor['name']!r}, got a model "
            f"of {model_sensor.get('name')!r} with another {', '.join(different_keys)}; choose a model of this sensor "
            "with --model, or train one"
        )


def measured_presses_for(model: ModelMetadata, dataset: Dataset) -> Dataset:
    """Select from a measured dataset the presses within the working area and the range of forces of a model.

    The manifest of the returned dataset is empty, because the ranges in the original manifest include the excluded
    presses.

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
    inside_count = int(is_inside.sum())
    check_enough(inside_count, len(presses), dataset.sensor.name)
    return replace(select_presses(dataset, is_inside), manifest={})
