"""Weights with which a service follows the pretension of a calibrated film: the file `pretensions.npz`.

The file contains networks of the film at several pretensions. All other parameters are those of the calibration. Each
network is adapted to the discrepancy and to the remaining uncertainty of the film, as the model itself is.
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
"""Number of pretensions for which the file has weights."""

MAX_PRETENSION_CHANGE_MPa = 1.4
"""Largest difference from the calibrated pretension, MPa, which corresponds to three or four degrees of temperature."""

N_TOUCHES = 300
"""Number of simulated touches from which the typical misfit is computed."""

SEED = 21
"""Seed of the simulated touches."""

MAX_TYPICAL_MISFIT = 1.5
"""Root mean square of the misfits of good touches, in units of the noise, above which a film cannot be followed."""


def pretensions_of(result: CalibrationResult, network: FoldedNetwork) -> Pretensions | None:
    """Compute the weights of the network of a calibrated film at other pretensions.

    One network is computed for each of several pretensions. The service interpolates between these networks.

    Args:
        result: The calibration.
        network: The network of the model.

    Returns:
        The weights; None if the pretension cannot be followed. This is the case with three electrodes, whose charges
        only suffice for the contact, and if the misfits of the network are too inaccurate on this film.
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

    # The networks have the same layers. Each array of weights is stacked over the nodes, shape (N_NODES, ...).
    arrays_of_networks = [_weight_arrays(node_network) for node_network in _networks_at(nodes, result, network)]
    stacked_weights = [np.stack(arrays) for arrays in zip(*arrays_of_networks, strict=True)]

    drifted_std = np.sqrt(np.diag(posterior.drifted(prior).covariance)) * prior.std
    pretensions = Pretensions(
        node_MPa=nodes,
        calibrated_MPa=calibrated_MPa,
        std_MPa=float(drifted_std[pretension]),
        floor_MPa=_lasting_std_MPa(result),
        misfit_rms=1.0,
        misfit_unit=MISFIT_UNIT,
        limits_pC=(LOWEST_CHARGE, HIGHEST_CHARGE),
        typical_pC=network.features.typical_pC,
        activation=network.layers.activation.name,
        weights=dict(zip(_weight_names(network), stacked_weights, strict=True)),
    )

    # The misfits of the networks are computed with `misfit_rms` = 1, and determine its final value.
    typical_misfit = _typical_misfit(pretensions, result)
    if typical_misfit > MAX_TYPICAL_MISFIT:
        return None
    return replace(pretensions, misfit_rms=max(typical_misfit, 1.0))


def _networks_at(pretensions_MPa: Array, result: CalibrationResult, network: FoldedNetwork) -> list[FoldedNetwork]:
    """Return one network for each pretension, with the other parameters of the calibrated film.

    Args:
        pretensions_MPa: The pretensions, shape (n,), MPa.
        result: The calibration.
        network: Network of the model, which is returned for the calibrated pretension.
    """
    calibrated_parameters = result.posterior.parameters
    pretension = result.problem.prior.index("pretension")
    networks = []
    for pretension_MPa in pretensions_MPa:
        if pretension_MPa == calibrated_parameters[pretension]:  # one of the pretensions is exactly the calibrated one
            networks.append(network)
            continue
        parameters = calibrated_parameters.copy()
        parameters[pretension] = pretension_MPa
        film_network = result.fitted_film(parameters).network
        networks.append(_with_correlations_of(network, film_network))
    return networks


def _typical_misfit(pretensions: Pretensions, result: CalibrationResult) -> float:
    """Return the root mean square of the misfits of simulated touches on the calibrated film, in units of the noise.

    Args:
        pretensions: Weights of the network at several pretensions.
        result: The calibration.
    """
    problem = result.problem
    rng = np.random.default_rng(SEED)
    touches = draw_contacts(rng, problem.domain, N_TOUCHES)
    film = problem.charges.forward_map(result.posterior.parameters)
    exact_charge = film.charges(touches) * result.charge_factor(result.posterior.unknowns, touches)
    charge = problem.noise.add(exact_charge, rng)
    calibrated_MPa = np.array([pretensions.calibrated_MPa])
    misfits = [pretensions.misfits(touch_charge, calibrated_MPa) for touch_charge in charge]
    return rms(np.array(misfits))


def _pretension_nodes(calibrated: float, lower: float, upper: float) -> Array:
    """Return Chebyshev nodes around the calibrated pretension, shape (N_NODES,), MPa.

    The nodes are stretched so that the first and the last of them lie at the ends of the range. The node that is
    closest to the calibrated pretension is moved to the calibrated pretension.

    Args:
        calibrated: The calibrated pretension, MPa.
        lower: Smallest pretension that a film may have, MPa.
        upper: Largest pretension that a film may have, MPa.
    """
    low = max(lower, calibrated - MAX_PRETENSION_CHANGE_MPa)
    high = min(upper, calibrated + MAX_PRETENSION_CHANGE_MPa)
    angle = np.pi * (np.arange(N_NODES) + 0.5) / N_NODES
    centre = 0.5 * (low + high)
    half_width = 0.5 * (high - low)
    nodes = centre - half_width * np.cos(angle) / np.cos(angle[0])  # the division stretches the nodes to both ends
    closest_node = np.abs(nodes - calibrated).argmin()
    nodes[closest_node] = calibrated
    return np.asarray(nodes)


def _with_correlations_of(network: FoldedNetwork, other: FoldedNetwork) -> FoldedNetwork:
    """Return a network with the correlations of the model, because correlations hardly change with the pretension.

    Args:
        network: Network of the model.
        other: Network of the film with another pretension, without correlations.
    """
    if not network.n_angle:
        return other
    # The network computes the correlations as angles. These outputs are the `angle_columns` of the last layer and of
    # the skip connection.
    columns = network.angle_columns
    last = network.layers.last
    angle_layer = Layer(last.weight[:, columns], last.bias[columns])
    angle_skip = network.layers.skip[:, columns]
    return other.with_angles(angle_layer, angle_skip)


def _weight_arrays(network: FoldedNetwork) -> list[np.ndarray]:
    """Return the weights of a network as single-precision arrays, in the order of `Pretensions`.

    The order is: weight and bias of each hidden layer, the skip connection, and bias and weight of the last layer.

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
    """Return the names of the constants of the ONNX graph that contain the weights, in the order of `_weight_arrays`.

    The constants are recognised by their values, because the names depend on how the graph is written.

    Args:
        network: The network.
    """
    graph = onnx.load_from_string(write_graph(network, {})).graph
    constants = {str(constant.name): numpy_helper.to_array(constant) for constant in graph.initializer}

    names = []
    for array in _weight_arrays(network):
        equal_names = [name for name, values in constants.items() if np.array_equal(values, array)]
        names.append(equal_names[0])
    return names


def _lasting_std_MPa(result: CalibrationResult) -> float:
    """Compute the standard deviation of the followed pretension that no number of touches reduces, MPa.

    The service estimates the pretension from the misfits of touches, by least squares. It takes all other parameters of
    the film from the calibration. Their errors therefore cause an error of the pretension that remains after any number
    of touches.

    Args:
        result: The calibration.
    """
    prior = result.problem.prior
    pretension = prior.index("pretension")
    misfit_jacobian = result.sensitivity.misfit_jacobian
    pretension_jacobian = misfit_jacobian[:, :, pretension]  # shape (n_touch, n_misfit)

    # Error of the least-squares estimate of the pretension for a unit error of each unknown p. The sums are over the
    # touches n and the misfits k of a touch.
    projection = np.einsum("nk,nkp->p", pretension_jacobian, misfit_jacobian)
    error_per_unknown = projection / (pretension_jacobian**2).sum()

    # The unknowns are in units of the standard deviations of the prior, and so is this variance.
    scaled_variance = error_per_unknown @ result.posterior.joint @ error_per_unknown
    return float(np.sqrt(scaled_variance) * prior.std[pretension])
