"""Comparison of an exported ONNX graph with the network from which it was written."""

from collections.abc import Callable, Sequence

import numpy as np
import onnxruntime as ort

from isocharge.common.arrays import Array, Singles
from isocharge.common.errors import TrainingError
from isocharge.serve.model.golden import FLOORS
from isocharge.serve.model.session import CORRELATION, open_session, run
from isocharge.serve.presses.number_table import LARGEST
from isocharge.train.data.channel_noise import Noise
from isocharge.train.data.presses import LOWEST_CHARGE, LabelledPresses

OutputFunction = Callable[[Array], tuple[Array, ...]]
"""Function from charges, shape (n, n_electrode), pC, to the outputs of a network in the order of the graph, float64."""

N_GOLDEN = 64
"""Number of golden vectors of a model.

Half of the charges belong to presses without noise, a quarter to presses with noise, and a quarter are extreme."""

TOLERANCES = {
    "contact": 1e-5,
    "contact_std": 1e-5,
    CORRELATION: 2e-4,
    "misfit": 2e-4,
}
"""Largest relative difference of each output between the graph (float32) and the network.

Rounding errors grow with the number of layers. With four hidden layers, they change a correlation by up to 1e-4, which
is much less than the statistical error of the correlation.
"""

N_COMPARED = 10_000
"""Number of presses with noise on which the graph and the network are compared."""

EXTREME_CHARGES_pC = (-LARGEST, LOWEST_CHARGE, LARGEST)
"""Charges for which every output must be finite, pC.

`LARGEST` is the largest float32 number. Charges below `LOWEST_CHARGE` are set to `LOWEST_CHARGE` before their logarithm
is computed. Therefore, `LOWEST_CHARGE` gives the smallest logarithm.
"""

EXTREME_SEED = 4
"""Seed of the combinations of extreme charges. Every check of a graph uses the same combinations."""

QUANTILE = 0.999
"""Fraction of the presses that must meet the tolerances.

For the remaining presses, the position can depend so strongly on the charges that float32 has too few digits."""

STD_FACTOR = 100.0
"""Smallest number by which a difference of a contact is divided, in standard deviations of the contact.

A difference of a thousandth of a standard deviation is negligible. With this divisor, such a difference is within the
tolerance."""

EXTREME_FACTOR = 10.0
"""Factor by which the tolerances are multiplied for the remaining presses, and for charges that no film produces."""


def check_graph(
    graph: bytes,
    compute_exact: OutputFunction,
    presses: LabelledPresses,
    noise: Noise,
    floors: Sequence[float] = FLOORS["contact"],
) -> Singles:
    """Compare a graph with its network, and choose charges for the golden vectors.

    Golden vectors are stored with a model, so that every computer can check its answers. The outputs of the graph and
    of the network are compared for noisy charges of presses and, with larger tolerances, for extreme charges.

    Args:
        graph: The ONNX file.
        compute_exact: Function that computes the outputs of the network in double precision.
        presses: Presses of the film.
        noise: Noise of good presses.
        floors: Values of x and y, mm, and of the force, N, below which differences count as absolute differences.

    Returns:
        Charges for the golden vectors, float32, shape (N_GOLDEN, n_electrode), pC.

    Raises:
        TrainingError: If an output is not finite, or the graph and the network disagree.
    """
    session = open_session(graph, "the exported graph")
    ordinary_charge, extreme_charge = _choose_golden_charges(compute_exact, presses, noise)
    _check_finite_outputs(session, n_electrode=presses.charge.shape[1])
    _compare(session, compute_exact, extreme_charge, floors, tolerance_factor=EXTREME_FACTOR)

    # If there are fewer than `N_COMPARED` presses, they are repeated.
    repeated_rows = np.arange(N_COMPARED) % len(presses)
    noisy_charge = presses[repeated_rows].noisy(noise, seed=3).astype(np.float32)
    _compare(session, compute_exact, noisy_charge, floors, tolerance_factor=1.0)
    return np.concatenate([ordinary_charge, extreme_charge])


def _choose_golden_charges(
    compute_exact: OutputFunction, presses: LabelledPresses, noise: Noise
) -> tuple[Singles, Singles]:
    """Choose charges for the golden vectors.

    Three quarters are charges of presses, and one quarter are extreme charges.

    Presses are only used if the standard deviation of their position is at most the median of all presses. For presses
    with larger standard deviations, a small change of a charge may move the estimated position by millimetres. On these
    presses, two runtimes that round float32 numbers differently could differ by more than the tolerance of the golden
    vectors.

    Args:
        compute_exact: Function that computes the outputs of the network in double precision.
        presses: Presses without noise.
        noise: Noise that is added to some of the charges.

    Returns:
        Charges of presses, shape (n, n_electrode), and extreme charges, shape (m, n_electrode), pC.
    """
    _, std, *_ = compute_exact(presses.charge)
    position_std = std[:, 0] + std[:, 1]  # a measure of the uncertainty of x and y
    well_determined_presses = presses[np.flatnonzero(position_std <= np.median(position_std))]

    # Half of the golden vectors are presses without noise. A quarter are every second of these presses, with noise.
    chosen_rows = np.linspace(0, len(well_determined_presses) - 1, N_GOLDEN // 2).astype(int)
    chosen_presses = well_determined_presses[chosen_rows]
    second_presses = chosen_presses[np.arange(0, len(chosen_presses), 2)]
    press_charge = np.concatenate([chosen_presses.charge, second_presses.noisy(noise, seed=2)])

    # The last quarter has charges of presses times factors from 0.001 to 1000, zero charges and negative charges.
    factor = np.geomspace(1e-3, 1e3, len(second_presses))
    extreme_charge = second_presses.charge * factor[:, None]  # one factor for all charges of a press
    extreme_charge[0] = 0.0
    extreme_charge[1] = -extreme_charge[1]
    return press_charge.astype(np.float32), extreme_charge.astype(np.float32)


def _check_finite_outputs(session: ort.InferenceSession, n_electrode: int) -> None:
    """Check that all outputs are finite for random combinations of `EXTREME_CHARGES_pC`.

    The network was not trained with such charges, so its outputs are extrapolations.

    Args:
        session: The exported graph.
        n_electrode: Number of charges of a press.

    Raises:
        TrainingError: If an output is infinite or NaN.
    """
    rng = np.random.default_rng(EXTREME_SEED)
    charges = rng.choice(EXTREME_CHARGES_pC, (N_COMPARED, n_electrode)).astype(np.float32)
    for name, output in run(session, charges).items():
        is_finite = np.isfinite(output).all(axis=1)  # one value for each row of charges
        if not is_finite.all():
            row = int(np.argmin(is_finite))  # the first row that is not finite
            raise TrainingError(
                f"the network answers {name} = {output[row]} to the charges {charges[row]} pC; expected finite "
                "numbers for any charges: train with more steps or another seed"
            )


def _compare(
    session: ort.InferenceSession,
    compute_exact: OutputFunction,
    charge: Singles,
    floors: Sequence[float],
    tolerance_factor: float,
) -> None:
    """Check that the graph and the network agree.

    The difference of a press is the largest relative difference among the columns of an output. Each output must meet
    two conditions. For the fraction `QUANTILE` of the presses, the difference must be within `tolerance_factor` times
    the tolerance of the output. For all presses, it must be within `EXTREME_FACTOR` times this tolerance.

    Args:
        session: The graph.
        compute_exact: Function that computes the outputs of the network in double precision.
        charge: Charges, shape (n, n_electrode), pC.
        floors: Values of x and y, mm, and of the force, N, below which differences count as absolute differences.
        tolerance_factor: Factor of the tolerance for the fraction `QUANTILE` of the presses.

    Raises:
        TrainingError: If the graph and the network disagree.
    """
    expected_outputs = compute_exact(charge.astype(float))
    _, expected_std, *_ = expected_outputs
    # A difference is divided by the magnitude of the expected value, or by the smallest divisor if this is larger.
    smallest_contact_divisor = np.maximum(floors, STD_FACTOR * expected_std)  # shape (n, 3)
    for expected, (name, graph_output) in zip(expected_outputs, run(session, charge).items(), strict=True):
        smallest_divisor = smallest_contact_divisor if name in ("contact", "contact_std") else 1.0
        divisor = np.maximum(np.abs(expected), smallest_divisor)
        relative_difference = np.abs(expected - graph_output) / divisor  # shape (n, number of columns)
        press_difference = relative_difference.max(axis=1)
        quantile_difference = float(np.quantile(press_difference, QUANTILE))
        largest_difference = float(press_difference.max())
        quantile_tolerance = tolerance_factor * TOLERANCES[name]
        tolerance = EXTREME_FACTOR * TOLERANCES[name]
        agrees = quantile_difference <= quantile_tolerance and largest_difference <= tolerance
        if not agrees:
            raise TrainingError(
                f"the exported graph disagrees with the network on {name}: expected at most {quantile_tolerance:g} for "
                f"{QUANTILE:.1%} of the charges and {tolerance:g} for all, got {quantile_difference:.3g} and "
                f"{largest_difference:.3g}"
            )
