"""Presses outside the working area, for training the misfit network and for measuring its detection rate.

The charges of most of these presses come from a coarse map of the whole film, whose error is a few percent near the
clamp. The error does not affect the training, because the misfit network is trained on the exact misfits of these
charges. The error hardly changes the measured share of wrong answers without a flag.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from isocharge.common.arrays import Booleans
from isocharge.serve.model.metadata import UnnoticedPresses
from isocharge.simulate import Domain
from isocharge.simulate.numerics.disk import Rings
from isocharge.train.data.contact_errors import rounded
from isocharge.train.data.presses import LabelledPresses

FORCE_RATIO = 10.0
"""Largest ratio of two forces among the presses on which shares of wrong answers are measured, dimensionless."""

N_SECTORS = 24
"""Number of rings outside the working area, and number of sectors in each ring."""

N_NEIGHBOURS = 8
"""Number of presses from which the share of a sector is computed: those nearest to the middle of the sector."""


@dataclass(frozen=True)
class OutsidePresses:
    """Presses between the working area of a network and the clamp.

    Attributes:
        domain: Working area and range of forces of the network.
        train: Presses from which the network learns which charges belong to no contact.
        test: Other presses, on which the share of wrong answers without a flag is measured. Their forces are at least
            the largest force divided by `FORCE_RATIO`.
        outer: Largest distance of a press from the centre, mm.
    """

    domain: Domain
    train: LabelledPresses
    test: LabelledPresses
    outer: float

    @classmethod
    def of(
        cls, domain: Domain, presses: LabelledPresses, outside: LabelledPresses | None = None, seed: int = 0
    ) -> "OutsidePresses | None":
        """Collect the presses outside a working area, and divide them into presses for training and for measuring.

        Args:
            domain: Working area and range of forces of the network.
            presses: Presses of the area for which a network was requested. Only those beyond the working area are used.
                There are some if the working area is smaller than the requested area.
            outside: Presses farther from the centre than all of `presses`; None if there are none.
            seed: Seed of the random choice of the presses for training and of the presses for measuring.

        Returns:
            The presses; None if fewer than `N_NEIGHBOURS` presses for measuring have a large enough force.
        """
        # Collect all presses outside, and divide them into two random halves.
        all_outside = presses[presses.distance > domain.radius]
        if outside is not None:
            contact = np.concatenate([all_outside.contact, outside.contact])
            all_outside = LabelledPresses(contact, np.concatenate([all_outside.charge, outside.charge]))
        shuffled = all_outside[np.random.default_rng(seed).permutation(len(all_outside))]
        half_count = len(shuffled) // 2
        train = shuffled[:half_count]
        second_half = shuffled[half_count:]

        # The share of wrong answers without a flag is measured without presses that are more than `FORCE_RATIO` times
        # weaker than the largest force. Each share is computed from `N_NEIGHBOURS` presses, so at least as many are
        # needed.
        _, max_force = domain.force_range
        test = second_half[second_half.contact[:, 2] >= max_force / FORCE_RATIO]
        if len(test) < N_NEIGHBOURS:
            return None
        return cls(domain, train, test, float(shuffled.distance.max()))

    def unnoticed_shares(self, is_unnoticed: Booleans) -> UnnoticedPresses:
        """For each sector of each ring, compute the share of presses with a wrong answer that carries no flag.

        Args:
            is_unnoticed: Whether the answer to each press of `test` is wrong and carries no flag, shape (n,).
        """
        # The area is divided into `N_SECTORS` rings of as many sectors. The share of a sector is that of the
        # `N_NEIGHBOURS` presses nearest to its middle.
        sector_middles = Rings.between(self.domain.radius, self.outer, rings=N_SECTORS, sectors=N_SECTORS)
        _, nearest_presses = cKDTree(self.test.contact[:, :2]).query(sector_middles.position, N_NEIGHBOURS)
        shares = is_unnoticed[nearest_presses].mean(axis=-1).round(2)  # shape (ring, sector)

        min_force, max_force = self.domain.force_range
        smallest_force = max(min_force, max_force / FORCE_RATIO)  # of the presses in `test`
        return UnnoticedPresses(
            from_mm=round(self.domain.radius, 4),
            to_mm=round(self.outer, 4),
            force_N=(rounded(smallest_force), rounded(max_force)),
            share=tuple(map(tuple, shares.tolist())),
        )
