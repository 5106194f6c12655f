"""Compensation of the leak of a charge amplifier, and integration of the currents of a board without such an amplifier.

A charge amplifier is a leaky integrator with the time constant tau = R C. The touch charge q follows from its output v
frame by frame,

    q[n] = q[n-1] + i[n] - b dt,        i[n] = v[n] - a v[n-1],        a = exp(-dt / tau),

where i is the innovation and b is the inflow (pC/s). The inflow is estimated from the innovation, because an estimate
from the output v would diverge; see `isocharge.serve.signal_chain.inflow`.

A board that sends currents sends the innovation itself, i[n] = v[n]. Its charge is the sum of the currents. If the
device file states a leak, the sum decays with the time constant tau, q[n] = a q[n-1] + i[n] - b dt.

While nothing touches the film, any charge is an error or comes from a slow warming of the film. The computed touch
charge therefore decays exponentially to zero.
"""

import math
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.frames.frame import Frame
from isocharge.serve.signal_chain.inflow import Inflow, LeakRule
from isocharge.serve.signal_chain.stage import OffsetStage, Setup


class Leak(OffsetStage):
    """Corrects the leak of the charge amplifiers, and estimates their inflow."""

    section = "leak"
    rule_class = LeakRule
    c_prefix = "LEAK"

    def __init__(self, setup: Setup) -> None:
        """Store the settings. The state begins at the first frame after the tare."""
        super().__init__(setup)
        self._rule = setup.rule(LeakRule) or LeakRule()
        self._tau_s = setup.for_each_electrode("leak.tau_s", self._rule.tau_s)
        self.reset()

    @classmethod
    def is_used(cls, setup: Setup) -> bool:
        """Return whether the device file states the leak of charge amplifiers."""
        return super().is_used(setup) and not setup.has_currents

    def reset(self) -> None:
        """Discard the state. A new state begins at the first frame after the next tare."""
        self._previous: Frame | None = None
        self._output_pC = np.zeros(len(self._tau_s))  # output of the amplifiers above the tare
        self._charge_pC = np.zeros(len(self._tau_s))  # touch charge
        self._inflow = Inflow(self._rule, len(self._tau_s))

    def step(self, frame: Frame) -> None:
        """Replace the output of the amplifiers by the touch charge, in which the leak of the amplifiers is corrected.

        The output v of an amplifier decays with its time constant tau. The innovation i of frame n is the difference
        between the output and the decayed previous output,

            i[n] = v[n] - exp(-dt / tau) v[n-1].

        The innovation consists of the inflow b dt (a slow current into the amplifier), noise and new touch charge. The
        touch charge is therefore q[n] = q[n-1] + i[n] - b dt. Out of contact, the touch charge also decays to zero, and
        the inflow is estimated.
        """
        output_pC = frame.charge_pC
        if output_pC is None:
            return
        if self._previous is not None:
            dt_s = frame.dt_s
            innovation_pC = self._innovation_pC(output_pC, np.exp(-dt_s / self._tau_s))
            surplus_pC = innovation_pC - self._inflow.pC_per_s * dt_s  # new touch charge and noise
            self._charge_pC = self._charge_pC + surplus_pC
            if self._previous.is_contact:
                self._inflow.pause()
            else:  # any charge is an error, and therefore decays to zero
                self._charge_pC = self._charge_pC * math.exp(-dt_s / self._rule.relax_s)
                if self._inflow.hold_s > 0.0 or not self._rule.learn:
                    self._inflow.hold_s -= dt_s
                else:
                    self._inflow.learn(surplus_pC, frame.noise_pC, dt_s)
        self._previous = frame
        self._output_pC = output_pC
        frame.charge_pC = self._charge_pC
        frame.base_relax_s = self._rule.relax_s

    def _innovation_pC(self, output_pC: Array, decay: Array) -> Array:
        """Return the change of the output that the leak does not explain, shape (n_electrode,), pC.

        Args:
            output_pC: Output of the amplifiers above the tare, shape (n_electrode,), pC.
            decay: Share of a charge that the leak leaves until this frame, shape (n_electrode,), dimensionless.
        """
        return output_pC - decay * self._output_pC

    def add_warming(self, warming_pC: Array | float) -> None:
        """Subtract the warming from the touch charge that the stage integrates."""
        self._charge_pC = self._charge_pC - warming_pC

    @classmethod
    def c_settings(cls, setup: Setup) -> dict[str, Any]:
        """Return the settings, with a time constant for each electrode."""
        settings = super().c_settings(setup)
        if settings:
            settings["tau_s"] = setup.for_each_electrode("leak.tau_s", settings["tau_s"])
        return settings


class Integrator(Leak):
    """Integrates the currents of a board to charges, and estimates the offset of the currents.

    The leak of the integral limits the charge that errors of the offset accumulate during a touch. Without a section
    `[leak]`, the integral has no leak.
    """

    section = ""
    c_prefix = ""

    @classmethod
    def is_used(cls, setup: Setup) -> bool:
        """Return whether the board sends currents."""
        return setup.has_currents

    def step(self, frame: Frame) -> None:
        """Replace the currents by the charges, and the noise of the currents by the noise of the charges at rest.

        At rest, the charges decay with the time constant `relax_s`. The sum of independent currents then has the
        variance of a current times relax_s / (2 dt).
        """
        super().step(frame)
        if frame.charge_pC is not None and frame.dt_s > 0.0:
            frame.noise_pC = frame.noise_pC * math.sqrt(max(1.0, 0.5 * self._rule.relax_s / frame.dt_s))

    def _innovation_pC(self, output_pC: Array, decay: Array) -> Array:
        """Return the current, plus the change of the charge because of the leak, shape (n_electrode,), pC."""
        return output_pC - (1.0 - decay) * self._charge_pC
