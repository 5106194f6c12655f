"""Robust least squares for a state that many presses share. The contact of each press is unknown or uncertain.

Each of n presses gives the charges q_i of e electrodes. A charge map predicts the charges Q(u_i, s) of a contact u_i
and a state s. The state contains the unknowns that all presses share, such as the pretension of a film. The estimate
minimises

    sum_i (nu + m_i) / 2 * ln(1 + chi2_i / nu) + 1/2 (s - s0)' P (s - s0),

    chi2_i = (q_i - Q(u_i, s))' V_i^-1 (q_i - Q(u_i, s)) + sum_k ((u_ik - v_ik) / w_ik)^2.

The first term is the negative logarithm of a Student's t distribution with nu degrees of freedom. A press that no
contact explains, such as a touch with two fingers, therefore hardly changes the state. m_i is the number of charges of
the press plus the number of its measured coordinates, minus three for the unknown coordinates of its contact. v_ik and
w_ik are a measured coordinate and its standard deviation. The last term is the negative logarithm of a Gaussian prior
of the state with the mean s0 and the precision P.

The minimum is found by damped Gauss-Newton steps with weights that follow from chi2_i (iteratively reweighted least
squares; Holland and Welsch 1977). The three coordinates of each contact are eliminated by their Schur complement, so
the time grows linearly with the number of presses.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array

FIRST_DAMPING = 1e-3
"""Damping of the first step, relative to the diagonal of the normal matrix."""

DAMPING_FACTOR = 10.0
"""Factor by which the damping decreases after a successful step, and increases after an unsuccessful step."""

RELATIVE_RIDGE = 1e-9
"""Value that is added to the diagonal of the normal matrix of a contact, relative to the trace of the matrix.

With this value, the matrix can be inverted even near a fold of the charge map.
"""

MAX_REJECTED_STEPS = 6
"""Number of successive unsuccessful steps after which the search ends."""


class ModelValues(NamedTuple):
    """Charges that a model predicts for n presses, and their derivatives.

    Attributes:
        charge_pC: Charges, shape (n, e), pC.
        by_contact: Derivatives with respect to the coordinates of the contact of each press, shape (n, e, 3).
        by_state: Derivatives with respect to the state, shape (n, e, p).
    """

    charge_pC: Array
    by_contact: Array
    by_state: Array


class RobustPoint(NamedTuple):
    """State and contacts of a `RobustProblem`, with the whitened residuals and derivatives at this point.

    Attributes:
        state: State, shape (p,).
        contacts: Contacts, shape (n, 3).
        residual: Whitened residuals of the charges, shape (n, e).
        by_contact: Whitened derivatives of the charges with respect to the contacts, shape (n, e, 3).
        by_state: Whitened derivatives of the charges with respect to the state, shape (n, e, p).
        contact_residual: Measured minus present coordinates, divided by their standard deviations, shape (n, 3).
        chi2: Squared residuals of the presses, shape (n,).
        weights: Weights of the presses, shape (n,).
        cost: Value of the minimised function.
    """

    state: Array
    contacts: Array
    residual: Array
    by_contact: Array
    by_state: Array
    contact_residual: Array
    chi2: Array
    weights: Array
    cost: float


class RobustProblem:
    """Least squares problem for the state that many presses share, and for the contact of each press."""

    def __init__(
        self,
        model: Callable[[Array, Array], ModelValues],
        charge_pC: Array,
        covariance_pC2: Array,
        prior_mean: Array,
        prior_covariance: Array,
        *,
        measured_contacts: Array | float = 0.0,
        contact_std: Array | float = np.inf,
        freedom: float = 4.0,
    ) -> None:
        """Compute the quantities that do not depend on the unknowns: whitening, precision and weights.

        The residuals of the charges are whitened: they are multiplied by a matrix that makes their errors independent,
        with the standard deviation 1.

        Args:
            model: Function that predicts the charges from contacts, shape (n, 3), and a state, shape (p,). The
                coordinates of a contact may have any meaning, for example x, y and the logarithm of the force.
            charge_pC: Measured charges of the presses, shape (n, e), pC.
            covariance_pC2: Covariances of the charges of each press, shape (n, e, e), pC^2.
            prior_mean: Mean of the Gaussian prior of the state, shape (p,).
            prior_covariance: Covariance of the Gaussian prior of the state, shape (p, p).
            measured_contacts: Measured coordinates of the contacts, shape (n, 3). Coordinates without a finite standard
                deviation are ignored.
            contact_std: Standard deviations of the measured coordinates, shape (n, 3); NaN or infinity for a coordinate
                that is not measured. By default, no coordinate is measured.
            freedom: Degrees of freedom nu of the distribution of the residuals. A large number stands for a Gaussian
                distribution.
        """
        self._model = model
        self._charge_pC = charge_pC
        self._whitening = np.linalg.inv(np.linalg.cholesky(covariance_pC2))  # one matrix per press, shape (n, e, e)
        self._prior_mean = prior_mean
        self._precision = np.linalg.inv(prior_covariance)
        self._freedom = freedom
        n_press, n_electrode = charge_pC.shape
        self._measured = np.nan_to_num(measured_contacts)
        # One over the standard deviations of the measured coordinates. The weight is 0 where a coordinate was not
        # measured, because 1 / inf is 0, and NaN is replaced by 0.
        self._contact_weight = np.broadcast_to(np.nan_to_num(1.0 / contact_std), (n_press, 3))
        # Number of independent residuals of each press: its measurements minus the three unknown coordinates
        measured_count = np.count_nonzero(self._contact_weight, axis=1)
        self._independent_count = n_electrode + measured_count - 3.0

    def estimate(
        self,
        start_state: Array,
        start_contacts: Array,
        *,
        contact_bounds: tuple[Array, Array] | tuple[float, float] = (-np.inf, np.inf),
        state_bounds: tuple[Array, Array] | tuple[float, float] = (-np.inf, np.inf),
        max_steps: int = 20,
        tolerance: float = 1e-3,
    ) -> RobustPoint:
        """Return the point with the most probable state and contacts.

        Args:
            start_state: State at which the search starts, shape (p,).
            start_contacts: Contacts at which the search starts, shape (n, 3).
            contact_bounds: Smallest and largest coordinates of contacts, each of shape (3,). The contacts are clipped.
            state_bounds: Smallest and largest values of the state, each of shape (p,). The state is clipped.
            max_steps: Largest number of steps.
            tolerance: The search ends when a step reduces the minimised function by less than this value. A step of one
                standard deviation of the state reduces the function by about 0.5.
        """
        point = self.evaluate(start_state, start_contacts)
        damping = FIRST_DAMPING
        rejected_count = 0  # successive unsuccessful steps
        for _ in range(max_steps):
            state_step, contact_step = self.step(point, damping)
            state = np.clip(point.state + state_step, *state_bounds)
            contacts = np.clip(point.contacts + contact_step, *contact_bounds)
            trial = self.evaluate(state, contacts)
            is_successful = trial.cost <= point.cost  # False if the cost is not a number
            if not is_successful:
                damping *= DAMPING_FACTOR
                rejected_count += 1
                if rejected_count > MAX_REJECTED_STEPS:
                    break
                continue
            rejected_count = 0
            damping /= DAMPING_FACTOR
            improvement = point.cost - trial.cost
            point = trial
            if improvement < tolerance:
                break
        return point

    def state_covariance(self, point: RobustPoint) -> Array:
        """Compute the covariance of the state in the problem that is linearised at a point, shape (p, p)."""
        normal_matrix, _ = self._normal_equations(point, *self._contact_shifts(point, damping=0.0))
        return np.asarray(np.linalg.inv(normal_matrix))

    def evaluate(self, state: Array, contacts: Array) -> RobustPoint:
        """Evaluate the model, the residuals and the cost at a state and contacts.

        The residuals of a press have a Student t distribution, so that a press with large residuals has little weight.
        The weights of the presses turn each step into a weighted least squares problem.

        Args:
            state: State, shape (p,).
            contacts: Contacts, shape (n, 3).
        """
        # Residuals divided by their standard deviations. The residuals of the charges are whitened. The residuals of
        # coordinates that were not measured are 0. `values` contains the predicted charges and their derivatives with
        # respect to the contacts (`by_contact`) and to the state (`by_state`).
        values = self._model(contacts, state)
        charge_difference_pC = self._charge_pC - values.charge_pC
        residual = (self._whitening @ charge_difference_pC[..., None])[..., 0]  # one matrix per press; shape (n, e)
        contact_residual = (self._measured - contacts) * self._contact_weight  # shape (n, 3)
        chi2 = (residual**2).sum(axis=1) + (contact_residual**2).sum(axis=1)  # shape (n,)

        # Weights and costs of a Student t distribution with nu degrees of freedom (`_freedom`), for a press with
        # `_independent_count` independent residuals
        weights = (self._freedom + self._independent_count) / (self._freedom + chi2)
        press_cost = 0.5 * (self._freedom + self._independent_count) * np.log1p(chi2 / self._freedom)

        # Cost of the deviation of the state from its Gaussian prior
        deviation = state - self._prior_mean
        prior_cost = 0.5 * deviation @ self._precision @ deviation
        return RobustPoint(
            state=state,
            contacts=contacts,
            residual=residual,
            by_contact=self._whitening @ values.by_contact,
            by_state=self._whitening @ values.by_state,
            contact_residual=contact_residual,
            chi2=chi2,
            weights=weights,
            cost=float(press_cost.sum() + prior_cost),
        )

    def _normal_equations(
        self, point: RobustPoint, contact_shift: Array, contact_by_state_step: Array
    ) -> tuple[Array, Array]:
        """Compute the normal equations N ds = g of a step ds of the state, from which the contacts are eliminated.

        For press i, r_i are the residuals of the e charges (measured minus predicted), shape (e,). C_i and S_i are the
        derivatives of the predicted charges with respect to the contact, shape (e, 3), and with respect to the p
        numbers of the state s, shape (e, p). All of them are whitened, so that the errors of the charges have the
        standard deviation 1. A prime denotes the transpose.

        After the step, the contact has moved by a_i - B_i ds. The residuals are then
        (r_i - C_i a_i) - (S_i - C_i B_i) ds. The step sets the derivative of the minimised function with respect to the
        state to zero. The prior has the mean s0 and the precision P. The weight w_i of press i is small if the
        residuals of the press are large. The condition for the step then gives

            N = P + sum_i w_i S_i' (S_i - C_i B_i),        g = P (s0 - s) + sum_i w_i S_i' (r_i - C_i a_i).

        Args:
            point: State s and contacts, with r_i (`residual`), C_i (`by_contact`), S_i (`by_state`) and w_i
                (`weights`).
            contact_shift: Shifts a_i of the contacts for an unchanged state, shape (n, 3).
            contact_by_state_step: Matrices B_i, shape (n, 3, p).

        Returns:
            Normal matrix N, shape (p, p), and right side g, shape (p,).
        """
        # The arrays are reshaped to one row for each charge of each press. A matrix product then sums over the presses.
        n_state = point.state.size
        reduced_slopes = point.by_state - point.by_contact @ contact_by_state_step  # S_i - C_i B_i
        reduced_residual = point.residual - (point.by_contact @ contact_shift[..., None])[..., 0]  # r_i - C_i a_i
        weighted_slopes = (point.weights[:, None, None] * point.by_state).reshape(-1, n_state)  # w_i S_i
        normal_matrix = self._precision + weighted_slopes.T @ reduced_slopes.reshape(-1, n_state)
        prior_side = self._precision @ (self._prior_mean - point.state)  # P (s0 - s)
        right_side = prior_side + weighted_slopes.T @ reduced_residual.ravel()
        symmetric_matrix = 0.5 * (normal_matrix + normal_matrix.T)  # N is symmetric except for rounding errors
        return symmetric_matrix, right_side

    def _contact_shifts(self, point: RobustPoint, damping: float) -> tuple[Array, Array]:
        """Compute how the contacts move, as a linear function of the step of the state.

        For a step ds of the state, the contact of press i moves by a_i - B_i ds. With a prime for the transpose,

            M_i a_i = C_i' r_i + W_i m_i,        M_i B_i = C_i' S_i,        M_i = C_i' C_i + W_i^2 (damped).

        - C_i and S_i are the whitened derivatives of the predicted charges with respect to the contact and the state.
        - r_i are the whitened residuals of the charges, measured minus predicted.
        - m_i are the measured minus the present coordinates, divided by their standard deviations.
        - W_i is the diagonal matrix of the inverse standard deviations of the measured coordinates. Its elements are 0
          for coordinates that were not measured.

        Args:
            point: State and contacts, with C_i (`by_contact`), S_i (`by_state`), r_i (`residual`) and m_i
                (`contact_residual`).
            damping: Relative increase of the diagonals of the matrices M_i.

        Returns:
            The shifts a_i, shape (n, 3), and the matrices B_i, shape (n, 3, p).
        """
        transposed = point.by_contact.swapaxes(1, 2)  # C_i'
        contact_matrix = transposed @ point.by_contact  # C_i' C_i; the following lines change it to M_i
        diagonal = np.einsum("nkk->nk", contact_matrix)  # a view; the changes of the view change the matrices
        diagonal += self._contact_weight**2  # the diagonal of W_i^2
        diagonal *= 1.0 + damping
        # The diagonal becomes a little larger, so that every matrix can be inverted. The smallest positive number is
        # for contacts that change no charge, and whose matrix is zero.
        diagonal += RELATIVE_RIDGE * diagonal.sum(axis=1, keepdims=True) + np.finfo(float).tiny

        # Solve for a_i and for the columns of B_i at once. The right sides are C_i' r_i + W_i m_i and C_i' S_i.
        charge_part = (transposed @ point.residual[..., None])[..., 0]
        contact_side = charge_part + self._contact_weight * point.contact_residual
        state_sides = transposed @ point.by_state  # shape (n, 3, p)
        right_sides = np.concatenate([contact_side[..., None], state_sides], axis=2)
        solution = np.linalg.solve(contact_matrix, right_sides)
        return solution[:, :, 0], solution[:, :, 1:]

    def step(self, point: RobustPoint, damping: float) -> tuple[Array, Array]:
        """Compute a damped Gauss-Newton step of the state and of the contacts.

        The contacts are first expressed by the step of the state: a contact moves by its shift for an unchanged state,
        minus a matrix times the step. The normal equations then contain only the p unknowns of the state.

        Args:
            point: State and n contacts at which the model is linearised.
            damping: Relative increase of the diagonals of the normal matrices (Levenberg-Marquardt).

        Returns:
            Step of the state, shape (p,), and steps of the contacts, shape (n, 3).
        """
        contact_shift, contact_by_state_step = self._contact_shifts(point, damping)  # shapes (n, 3) and (n, 3, p)
        normal_matrix, right_side = self._normal_equations(point, contact_shift, contact_by_state_step)
        damped_matrix = normal_matrix + damping * np.diag(np.diag(normal_matrix))
        state_step = np.linalg.solve(damped_matrix, right_side)
        contact_step = contact_shift - contact_by_state_step @ state_step
        return np.asarray(state_step), contact_step
