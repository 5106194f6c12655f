"""Compensation of the leak of a charge amplifier.

A charge amplifier is a leaky integrator with the time constant tau = R C. The touch charge q follows from its output v
frame by frame,

    q[n] = q[n-1] + i[n] - b dt,        i[n] = v[n] - a v[n-1],        a = exp(-dt / tau),

where i is the innovation and b is the inflow (pC/s). The inflow is estimated from the innovation, because an estimate
from the output v would diverge; see `isocharge.serve.signal_chain.inflow`.

While nothing touches the film, any charge is an error or comes from a slow warming of the film. The computed touch
charge therefore decays exponentially to zero.
"""

import math
from typing import Any

import numpy as np

from isocharge.serve.frames.frame import Frame
from isocharge.serve.signal_chain.inflow import Inflow, LeakSection
from isocharge.serve.signal_chain.memory import MemoryRule
from isocharge.serve.signal_chain.stage import OffsetStage, Setup, WarmingChange


class Leak(OffsetStage):
    """Corrects the leak of the charge amplifiers, and estimates their inflow."""

    section = "leak"
    rule_class = LeakSection
    c_prefix = "LEAK"

    def __init__(self, setup: Setup) -> None:
        """Store the settings. The state begins at the first frame after the tare."""
        super().__init__(setup)
        rule = setup.rule(LeakSection)
        assert rule is not None
        self._rule = rule
        self._tau_s = setup.for_each_electrode("leak.tau_s", rule.tau_s)
        self.reset()

    @classmethod
    def is_used(cls, setup: Setup) -> bool:
        """Return whether the amplifiers leak. If the film has a memory, a later stage corrects both together."""
        return super().is_used(setup) and setup.rule(MemoryRule) is None

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
            innovation_pC = output_pC - np.exp(-dt_s / self._tau_s) * self._output_pC
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

    def add_warming(self, change: WarmingChange) -> None:
        """Subtract the warming from the touch charge that the stage integrates."""
        self._charge_pC = self._charge_pC - change.charge_pC

    @classmethod
    def c_settings(cls, setup: Setup) -> dict[str, Any]:
        """Return the settings, with a time constant for each electrode."""
        settings = super().c_settings(setup)
        if settings:
            settings["tau_s"] = setup.for_each_electrode("leak.tau_s", settings["tau_s"])
        return settings
