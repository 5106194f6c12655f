"""Base class of the settings of a stage, and types of bounded numbers for these settings.

The settings of a stage are a section of a device file.
"""

from typing import Annotated

from msgspec import Meta

from isocharge.common.structs import Settings

LARGEST = 1_000_000_000
"""Largest value of a setting, in the unit of the setting."""

Setting = Annotated[float, Meta(ge=0, le=LARGEST)]
"""Number from 0 to `LARGEST`."""

Share = Annotated[float, Meta(ge=0, lt=1)]
"""Share of a whole, from 0 to below 1, dimensionless."""

Count = Annotated[int, Meta(ge=0, le=LARGEST)]
"""Whole number from 0 to `LARGEST`."""

TimeConstant = Annotated[float, Meta(ge=1e-3, le=LARGEST)]
"""Time constant, s. It is never 0, because the signal chain divides by it."""


class Rule(Settings, frozen=True):
    """The settings of a stage.

    Attributes:
        on: Whether a device file switches the stage on.
    """

    on: bool = True
