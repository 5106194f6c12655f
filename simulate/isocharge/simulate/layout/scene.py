"""What a layout is designed for: presses, what nobody knows exactly about them, and the noise."""

from dataclasses import dataclass, replace

import numpy as np

from isocharge.common.errors import InputError, SceneError
from isocharge.simulate.forward.solve_family import check_family
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.probe import Circle, Probe

LEAST_FACTOR = 0.5
"""Smallest radius of a probe that is solved to learn what its radius does, over the radius itself."""


@dataclass(frozen=True)
class Nuisances:
    """One standard deviation of each thing that nobody knows exactly when a press is read.

    Attributes:
        probe_radius: m.
        profile: Of the pressure under the probe: 0 uniform, 1 that of a rigid flat punch; dimensionless. Anything
            between is equally likely, which has a standard deviation of 1 / sqrt(12).
        pretension: What a calibration leaves unknown, Pa.
        gain: Of every electrode by itself, dimensionless.
    """

    probe_radius: float = 0.3e-3
    profile: float = float(1.0 / np.sqrt(12.0))
    pretension: float = 0.1e6
    gain: float = 2e-3

    def __post_init__(self) -> None:
        for name in ("probe_radius", "profile", "pretension", "gain"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0.0):
                raise InputError(f"nuisance {name}: expected a number from 0, got {value}")

    @classmethod
    def none(cls) -> "Nuisances":
        """Everything is known."""
        return cls(0.0, 0.0, 0.0, 0.0)

    @classmethod
    def probe_and_pretension(cls) -> "Nuisances":
        """Only the radius of the probe and the pretension are unknown."""
        return cls(profile=0.0, gain=0.0)


@dataclass(frozen=True)
class DesignScene:
    """Presses of one probe with one force on one film, anywhere within a disk.

    Attributes:
        film: The film; its pretension is that of the scene.
        probe: The footprint, round.
        force: N.
        radius: Largest distance of a press from the film's centre, m.
    """

    film: Film
    probe: Circle
    force: float
    radius: float

    @classmethod
    def of(cls, film: Film, probe: Probe, force: float, radius: float) -> "DesignScene":
        """A scene whose presses can be solved.

        Raises:
            SceneError: If the probe is not round, or some presses cannot exist.
        """
        if not isinstance(probe, Circle):
            raise SceneError(f"probe: a layout is designed for round probes, got {probe.notation}; use circle:RADIUS")
        check_family(film, Circle(2.0 * probe.radius), radius, (force, force))
        return cls(film, probe, force, radius)

    @property
    def radius_step(self) -> float:
        """Change of the probe's radius from which its effect is learned, m: the usual uncertainty."""
        return min(Nuisances().probe_radius, (1.0 - LEAST_FACTOR) * self.probe.radius)

    @property
    def pretension_step(self) -> float:
        """Change of the pretension from which its effect is learned, Pa."""
        return Nuisances().pretension

    def with_probe(self, radius: float) -> "DesignScene":
        """The same presses with a probe of another radius (m)."""
        return replace(self, probe=Circle(radius))

    def with_pretension(self, pretension: float) -> "DesignScene":
        """The same presses on a film of another pretension (Pa)."""
        return replace(self, film=replace(self.film, pretension=pretension))
