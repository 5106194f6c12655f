"""Interface of the stages of a stream, and types and settings that several stages use.

A frame passes through the stages of a stream in the order of the list `isocharge.serve.live.device.STAGES`. Each stage
reads and writes attributes of the frame. To add a stage, write a class and add it to the list. The class declares the
section of the device file that contains its settings. The help of the device file, the stages of a stream and the
export to C follow from the list.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, TypeVar, cast

import numpy as np
from msgspec import Meta, field, structs

from isocharge.common.arrays import Array
from isocharge.common.errors import DeviceError
from isocharge.common.structs import Settings
from isocharge.serve.frames.formats import AutoFrames, Frames
from isocharge.serve.frames.frame import Frame, Parser
from isocharge.serve.model.predictor import Predictor
from isocharge.serve.port.serial_line import Request

LARGEST = 1_000_000_000
"""Largest value of a setting, in the unit of the setting, and largest charge of a valid reading, pC.

Sums of such charges are exact to 1e-7 pC in double precision.
"""

SUM_TOLERANCE_s = 1e-5
"""Time by which a sum of sampling intervals may fall short of a limit, s.

With this tolerance, the sum reaches the limit at the same frame in single and in double precision. The signal chain in
C can be compiled in single precision.
"""

Setting = Annotated[float, Meta(ge=0, le=LARGEST)]
"""Number from 0 to `LARGEST`."""

Share = Annotated[float, Meta(ge=0, lt=1)]
"""Share of a whole, from 0 to below 1, dimensionless."""

Count = Annotated[int, Meta(ge=0, le=LARGEST)]
"""Whole number from 0 to `LARGEST`."""

Divisor = Annotated[float, Meta(ge=1e-3, le=LARGEST)]
"""Number by which the signal chain divides, such as a time constant. It is never 0."""


class Rule(Settings, frozen=True):
    """The settings of a stage.

    Attributes:
        on: Whether a device file switches the stage on.
    """

    on: bool = True


R = TypeVar("R", bound=Rule)

NOT_IN_C = (
    "this stage does not exist in the signal chain in C; remove it from the device file, or run `isocharge serve "
    "stream` on a host"
)
"""Part of the message about a stage that cannot be exported to C."""


class Board(Settings, frozen=True):
    """The part of a device file that does not belong to a stage.

    Attributes:
        name: Name of the board.
        front_end: Whether the values of the board are charges or currents. A current is the charge of one sampling
            interval.
        frames: Format of the frames.
        channels: Name or number of the channel of each electrode; empty without the section `[channels]`.
    """

    name: str = "unnamed board"
    front_end: Literal["charge", "current"] = "charge"
    frames: Frames = AutoFrames()
    channels: dict[str, str] = field(default_factory=dict)


class Device(Board, frozen=True):
    """Settings of a board, as its device file states them.

    Attributes:
        rules: Settings of each stage that is switched on, by their class.
        table: Unconverted content of the device file, which is stored in recordings.
        where: Name of the file, for messages.
    """

    rules: Mapping[type[Rule], Rule] = field(default_factory=dict)
    table: Mapping[str, Any] = field(default_factory=dict)
    where: str = "device"

    @property
    def has_currents(self) -> bool:
        """Whether each value of the board is a current, which is the charge of one sampling interval."""
        return self.front_end == "current"

    @property
    def request(self) -> Request | None:
        """Request that the board answers with a frame, or None if the board sends frames without requests."""
        if self.frames.request is None:
            return None
        return Request(bytes.fromhex(self.frames.request), self.frames.request_Hz)

    def parser(self) -> Parser:
        """Return a new parser that reads the frames of the board."""
        return self.frames.parser()

    def rule(self, rule_class: type[R]) -> R | None:
        """Return the settings of a class, or None if their stage is switched off."""
        return cast("R | None", self.rules.get(rule_class))


NO_SETTINGS = Device()
"""Settings that switch on only the stages that each stream has."""


@dataclass(slots=True)
class Setup:
    """Settings and objects that the stages of a stream share.

    Attributes:
        electrodes: Names of the electrodes, in the order of the charges.
        device: Settings of the board.
        predictor: The present model; None if a stream computes only touch charges.
        reader: Name of the part of the program that needs these electrodes, such as "model three/1", for messages.
        has_any_sign: Whether the charges of a touch may have any sign. Otherwise, most of them are positive.
    """

    electrodes: tuple[str, ...]
    device: Device = NO_SETTINGS
    predictor: Predictor | None = None
    reader: str = "the sensor"
    has_any_sign: bool = False

    def __post_init__(self) -> None:
        """Allow charges of any sign for a board that sends currents."""
        self.has_any_sign |= self.device.has_currents

    def use(self, predictor: Predictor) -> None:
        """Store the model to be used, its label, and whether charges of its film may be negative."""
        self.predictor = predictor
        self.reader = f"model {predictor.metadata.label}"
        self.has_any_sign = self.device.has_currents or predictor.metadata.has_any_sign

    @property
    def model(self) -> Predictor:
        """The present model of a stream that has a model."""
        assert self.predictor is not None
        return self.predictor

    def for_each_electrode(self, key: str, setting: float | Mapping[str, float]) -> Array:
        """Return the value of a setting for each electrode, shape (n_electrode,).

        Args:
            key: Section and key of the setting, for messages.
            setting: One number for all electrodes, or a dictionary of numbers by electrode name.

        Raises:
            DeviceError: If the keys of the dictionary are not exactly the electrodes.
        """
        numbers = setting if isinstance(setting, Mapping) else dict.fromkeys(self.electrodes, setting)
        if set(numbers) != set(self.electrodes):
            raise DeviceError(
                f"{self.device.where}: {key}: expected a number, or one for each of the electrodes "
                f"{self.electrodes}, got {setting}"
            )
        return np.array([numbers[name] for name in self.electrodes], dtype=float)


class Stage(ABC):
    """One step of the processing that converts the values of a frame to a record.

    The object contains the settings and the state of the stage. A stage must be used in one thread only. Equal
    sequences of frames always give equal results.

    Attributes:
        section: Name of the section of the device file with the settings; empty if the stage has no settings.
        rule_class: Class of the settings.
        is_required: Whether each stream has the stage, even if the device file switches it off.
        is_default: Whether the stage is switched on, with default settings, if the device file has no such section.
        front_end: Kind of board for which a stream has the stage; None for every board.
        needs_model: Whether only a stream with a model has the stage.
        needs_contact: Whether the stage processes the contact of a record. Such a stage skips frames without a record,
            and is not part of an export to C.
    """

    section: ClassVar[str] = ""
    rule_class: ClassVar[type[Rule]] = Rule
    is_required: ClassVar[bool] = False
    is_default: ClassVar[bool] = False
    front_end: ClassVar[str | None] = None
    needs_model: ClassVar[bool] = False
    needs_contact: ClassVar[bool] = False

    def __init__(self, setup: Setup) -> None:  # noqa: B027  # some stages have no settings
        """Begin without any frame.

        Args:
            setup: Settings of all stages, and objects that the stages share.
        """

    @classmethod
    def is_used(cls, setup: Setup) -> bool:
        """Return whether a stream has this stage."""
        is_on = cls.is_required or cls.rule_class in setup.device.rules
        fits_board = cls.front_end in (None, setup.device.front_end)
        lacks_model = cls.needs_model and setup.predictor is None
        return is_on and fits_board and not lacks_model

    @abstractmethod
    def step(self, frame: Frame) -> None:
        """Process the next frame in place.

        A frame without charges is invalid, or comes before the first tare. Most stages ignore such a frame.
        """

    def reset(self) -> None:  # noqa: B027  # some stages have no state
        """Discard the state of the present touch, because the film is tared again."""

    @classmethod
    def c_settings(cls, setup: Setup) -> dict[str, Any]:
        """Return the settings of the stage for C by name, as numbers, truth values or arrays.

        The C sources contain these settings in macros with the name of the section.

        Raises:
            DeviceError: If the stage does not exist in C with these settings.
        """
        rule = setup.device.rule(cls.rule_class)
        return {} if rule is None else structs.asdict(rule)
