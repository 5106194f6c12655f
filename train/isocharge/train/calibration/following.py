"""Content of the file `pretensions.npz`. A service needs this file to follow the pretension of a calibrated film.

The file contains the weights of several networks. Each network belongs to the calibrated film at a different
pretension; all other parameters of the film are as calibrated. Like the network of the model, each of these networks is
adapted to the discrepancy and to the remaining uncertainty of the film.
"""

from dataclasses import replace

import numpy as np
import onnx
from onnx import numpy_helper

from isocharge.common.arrays import Array
from isocharge.common.perceptron import Layer
from isocharge.common.statistics import rms
from isocharge.serve.model.pretensions import Pretensions
from isocharge.train.calibration.result import CalibrationResult
from isocharge.train.data.presses import HIGHEST_CHARGE, LOWEST_CHARGE, draw_contacts
from isocharge.train.model_release.onnx_graph import write_graph
from isocharge.train.training.folded_network import MISFIT_UNIT, FoldedNetwork

N_NODES = 6
"""Number of pretensions for which the file contains weights."""

MAX_PRETENSION_CHANGE_MPa = 1.4
"""Largest difference from the calibrated pretension for which the file contains weights, MPa.

This difference corresponds to a change of the temperature by three or four degrees."""

N_TOUCHES = 300
"""Number of simulated touches from which the typical misfit is computed."""

SEED = 21
"""Seed of the simulated touches."""

MAX_TYPICAL_MISFIT = 1.5
"""Root mean square of the misfits of good touches, in units of the noise, above which a film cannot be followed."""


def pretensions_of(result: CalibrationResult, network: FoldedNetwork) -> Pretensions | None:
    """Compute networks for a calibrated film at several pretensions.

    A service interpolates between these networks to follow the pretension of the film.

    Args:
        result: Result of the calibration.
        network: The network of the model, which is that of the calibrated pretension.

    Returns:
        The weights of the networks, or None if the pretension cannot be followed. It cannot be followed with three
        electrodes, because three charges only determine the contact. It also cannot be followed if the misfits of good
        touches on this film are too large.
    """
    problem = result.problem
    posterior = result.posterior
    if len(problem.electrodes) <= 3:
        return None

    prior = problem.prior
    pretension = prior.index("pretension")
    calibrated_MPa = float(posterior.parameters[pretension])
    lower, upper = (float(bound[pretension]) for bound in prior.bounds)
    nodes = _pretension_nodes(calibrated_MPa, lower, upper)

    # All networks have the same layers. The arrays of the N_NODES networks that belong to the same layer are stacked,
    # shape (N_NODES, ...).
    arrays_of_networks = [_weight_arrays(node_network) for node_network in _networks_at(nodes, result, network)]
    stacked_weights = [np.stack(arrays) for arrays in zip(*arrays_of_networks, strict=True)]

    # When a stream begins, the film may have drifted since the calibration.
    drifted_std = np.sqrt(np.diag(posterior.drifted(prior).covariance)) * prior.std
    pretensions = Pretensions(
        node_MPa=nodes,
        calibrated_MPa=calibrated_MPa,
        std_MPa=float(drifted_std[pretension]),
        floor_MPa=_pretension_difference_std_MPa(result),
        misfit_rms=1.0,
        misfit_unit=MISFIT_UNIT,
        limits_pC=(LOWEST_CHARGE, HIGHEST_CHARGE),
        typical_pC=network.features.typical_pC,
        activation=network.layers.activation.name,
        weights=dict(zip(_weight_names(network), stacked_weights, strict=True)),
    )

    # So far, `misfit_rms` is 1. Its final value is computed from the misfits of simulated touches.
    typical_misfit = _typical_misfit(pretensions, result)
    if typical_misfit > MAX_TYPICAL_MISFIT:
        return None
    return replace(pretensions, misfit_rms=max(typical_misfit, 1.0))


def _networks_at(pretensions_MPa: Array, result: CalibrationResult, network: FoldedNetwork) -> list[FoldedNetwork]:
    """Return networks for the calibrated film, one for each of several pretensions.

    Args:
        pretensions_MPa: The pretensions, shape (n,), MPa.
        result: The calibration, which defines the other parameters of the film.
        network: Network of the model, which is returned for the calibrated pretension.
    """
    calibrated_parameters = result.posterior.parameters
    pretension = result.problem.prior.index("pretension")
    networks = []
    for pretension_MPa in pretensions_MPa:
        if pretension_MPa == calibrated_parameters[pretension]:  # exactly equal, because one node was set to this value
            networks.append(network)
            continue
        parameters = calibrated_parameters.copy()
        parameters[pretension] = pretension_MPa
        film_network = result.fitted_film(parameters).network
        networks.append(_with_correlations_of(network, film_network))
    return networks


def _typical_misfit(pretensions: Pretensions, result: CalibrationResult) -> float:
    """Simulate touches on the calibrated film, and return the root mean square of their misfits in units of the noise.

    Args:
        pretensions: Weights of the networks at several pretensions.
        result: Result of the calibration.
    """
    problem = result.problem
    rng = np.random.default_rng(SEED)
    touches = draw_contacts(rng, problem.domain, N_TOUCHES)
    # Charges of the calibrated film: those of its parameters, multiplied by a factor for its coefficients and friction
    film = problem.charges.forward_map(result.posterior.parameters)
    exact_charge = film.charges(touches) * result.charge_factor(result.posterior.unknowns, touches)
    charge = problem.noise.add(exact_charge, rng)
    calibrated_MPa = np.array([pretensions.calibrated_MPa])
    misfits = [pretensions.misfits(touch_charge, calibrated_MPa) for touch_charge in charge]
    return rms(np.array(misfits))


def _pretension_nodes(calibrated_MPa: float, lower_MPa: float, upper_MPa: float) -> Array:
    """Return Chebyshev nodes around the calibrated pretension, shape (N_NODES,), MPa.

    The nodes are stretched, so that the first and the last node lie at the ends of the range. On both sides of the
    calibrated pretension, this range is limited to `MAX_PRETENSION_CHANGE_MPa`. The node closest to the calibrated
    pretension is replaced by this pretension.

    Args:
        calibrated_MPa: The calibrated pretension, MPa.
        lower_MPa: Smallest pretension that a film may have, MPa.
        upper_MPa: Largest pretension that a film may have, MPa.
    """
    low = max(lower_MPa, calibrated_MPa - MAX_PRETENSION_CHANGE_MPa)
    high = min(upper_MPa, calibrated_MPa + MAX_PRETENSION_CHANGE_MPa)
    angle = np.pi * (np.arange(N_NODES) + 0.5) / N_NODES
    centre = 0.5 * (low + high)
    half_width = 0.5 * (high - low)
    nodes = centre - half_width * np.cos(angle) / np.cos(angle[0])  # the division stretches the nodes to both ends
    closest_node = np.abs(nodes - calibrated_MPa).argmin()
    nodes[closest_node] = calibrated_MPa
    return np.asarray(nodes)


def _with_correlations_of(model_network: FoldedNetwork, film_network: FoldedNetwork) -> FoldedNetwork:
    """Copy the outputs for correlations from the network of the model to another network.

    The correlations are not computed again, because they hardly change with the pretension.

    Args:
        model_network: Network of the model. If it has no outputs for correlations, nothing is copied.
        film_network: Network of the film with another pretension, without outputs for correlations.

    Returns:
        The other network with outputs for the correlations.
    """
    if not model_network.n_angle:
        return film_network
    # The network computes correlations as angles. Their outputs are columns of the last layer and of the skip
    # connection.
    columns = model_network.angle_columns
    last_layer = model_network.layers.last
    angle_layer = Layer(last_layer.weight[:, columns], last_layer.bias[columns])
    angle_skip = model_network.layers.skip[:, columns]
    return film_network.with_angles(angle_layer, angle_skip)


def _weight_arrays(network: FoldedNetwork) -> list[np.ndarray]:
    """Return the weights of a network as single-precision arrays, in the order that `Pretensions` expects.

    The weight and the bias of each hidden layer come first. Then follow the weight of the skip connection, the bias of
    the last layer, and the weight of the last layer.

    Args:
        network: The network.
    """
    layers = network.layers
    arrays: list[Array] = []
    for layer in layers.hidden:
        arrays += [layer.weight, layer.bias]
    arrays += [layers.skip, layers.last.bias, layers.last.weight]
    return [np.asarray(array, dtype=np.float32) for array in arrays]


def _weight_names(network: FoldedNetwork) -> list[str]:
    """Return the names of the ONNX constants with the weights of a network, in the order of `_weight_arrays`.

    The constants are recognised by their values, because their names depend on how the ONNX graph is written.

    Args:
        network: The network, for which an ONNX graph is created.
    """
    graph = onnx.load_from_string(write_graph(network, {})).graph
    constants = {str(constant.name): numpy_helper.to_array(constant) for constant in graph.initializer}

    names = []
    for array in _weight_arrays(network):
        matching_names = [name for name, values in constants.items() if np.array_equal(values, array)]
        names.append(matching_names[0])
    return names


def _pretension_difference_std_MPa(result: CalibrationResult) -> float:
    """Compute how much the pretension that is estimated from many touches differs from the calibrated pretension.

    The result is the standard deviation of this difference, MPa, for a film that has not changed since the calibration.
    Further touches do not reduce the difference.

    A service estimates the pretension by least squares from the misfits of touches. A misfit is the part of the charges
    that no contact explains. The service uses the calibrated values of the other unknowns of the film. Their errors
    therefore change the estimated pretension. An error of the calibrated pretension does not change the estimate, but
    the difference from the calibrated pretension. It contributes with the factor 1.

    The difference from the calibrated pretension is computed, and not the error of the estimate, because the errors of
    the calibrated unknowns are correlated. The calibrated pretension partly compensates for the errors of the other
    unknowns. A film with the true pretension and with these errors would usually answer worse than the calibrated film.

    Args:
        result: Result of the calibration.
    """
    prior = result.problem.prior
    pretension = prior.index("pretension")
    misfit_jacobian = result.sensitivity.misfit_jacobian
    pretension_jacobian = misfit_jacobian[:, :, pretension]  # shape (n_touch, n_misfit)

    # Calibrated pretension minus the least-squares estimate of the pretension if the calibrated value of the unknown p
    # has the error 1. The sums extend over the touches n and the misfits k of each touch.
    projection = np.einsum("nk,nkp->p", pretension_jacobian, misfit_jacobian)
    difference_per_unknown = projection / (pretension_jacobian**2).sum()

    # Parameters are in units of their prior standard deviations, and so is the difference of the pretensions.
    scaled_variance = difference_per_unknown @ result.posterior.joint @ difference_per_unknown
    return float(np.sqrt(scaled_variance) * prior.std[pretension])
