"""Device file, which contains the settings of a board and its amplifiers in TOML.

    name = "bench board 3"         # optional
    front_end = "charge"           # optional; "current" if each value is the charge of one sampling interval

    [frames]                       # optional; without this section the format is recognised
    format = "described"           # or "auto", "binary", "text"; the keys of "described" are those of
                                   # isocharge.serve.frames.frame_layout, the keys of the others those of .formats
    request = "3F 0A"              # bytes that request a frame from the board, hexadecimal; optional

    [channels]                     # name or number of each electrode's channel; without this section, channels are
    A = "adc0"                     # assigned by the names of the electrodes, or by their order

    [gain]                         # optional; each setting is a number, or a number for each electrode
    offset = 8388608               # value of the board without charge, in its unit; optional
    pC_per_unit = {A = 0.0457, B = -0.0459, C = 0.0457}     # negative where the amplifier inverts

    [saturation]
    limit_pC = 1500.0

    [leak]
    tau_s = {A = 10.0, B = 10.2, C = 9.9}

The sections that are not shown contain the settings of the other stages. `STAGES` lists the stages, and each stage
states its section and the class of its settings. The key `on = false` switches off the stage to which the section
belongs. The stages of the sections `[tare]` and `[touch]` are switched on, with their default settings, even if the
file has no such section. An unknown key causes an error.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from msgspec import defstruct, structs

from isocharge.common.arrays import Array
from isocharge.common.errors import DeviceError
from isocharge.common.files import StrPath
from isocharge.common.structs import convert, read_toml
from isocharge.serve.frames.frame import Frame
from isocharge.serve.model.predictor import Predictor
from isocharge.serve.signal_chain.channels import Gain, Saturation
from isocharge.serve.signal_chain.hum import Hum
from isocharge.serve.signal_chain.leak import Integrator, Leak
from isocharge.serve.signal_chain.stage import Board, Device, Rule, Setting, Setup, Share, Stage
from isocharge.serve.signal_chain.tare import Tare
from isocharge.serve.signal_chain.thermal import Warming
from isocharge.serve.signal_chain.touch import Touch
from isocharge.serve.tracking.film_follower import FilmFollower
from isocharge.serve.tracking.tracker import Tracker


class NoiseRule(Rule, frozen=True, kw_only=True):
    """Noise of the charges of a bench, from the section `[noise]` of a device file.

    The variance of the noise of a charge q is `white_pC`^2 + (`gain` q)^2.

    Attributes:
        white_pC: Standard deviation of the part that does not depend on the charge, pC.
        gain: Standard deviation of the part that is proportional to the charge, relative to the charge.
    """

    white_pC: Setting = 1.0
    gain: Share


def predictor_for(device: Device, predictor: Predictor) -> Predictor:
    """Return a predictor for the noise that a device file states, or the same predictor if the file states no noise."""
    noise = device.rule(NoiseRule)
    return predictor if noise is None else predictor.with_noise(noise.white_pC, noise.gain)


class Prediction(Stage):
    """Predicts the contact of each frame with the present model, for the noise that the device file states.

    If the measured noise is much larger, the standard deviations are computed for the measured noise.
    """

    section = "noise"
    rule_class = NoiseRule
    is_required = True
    needs_contact = True

    def __init__(self, setup: Setup) -> None:
        """Create the predictor for the noise of the board, and store the predictor in the setup for the later stages.

        A contact is valid within the working area and the forces of this predictor. `setup.model` returns the predictor
        that is stored in the setup.
        """
        self._setup = setup
        self._predictor = predictor_for(setup.device, setup.model)
        setup.predictor = self._predictor
        self._noise_pC: Array | None = None  # noise for which the predictor was chosen

    def step(self, frame: Frame) -> None:
        """Predict the contact of a frame, unless nothing touches the film or the frame has no charges.

        The predictor for the measured noise is stored in the setup for the later stages. The error of an estimated
        warming is added to the uncertainty of the contact.
        """
        if frame.charge_pC is None or not frame.is_contact:
            return
        # An array is never changed in place. Another array is therefore another noise: the film was tared, or the board
        # sends currents.
        if frame.noise_pC is not self._noise_pC:
            self._noise_pC = frame.noise_pC
            self._setup.predictor = self._predictor.for_measured_noise(frame.noise_pC)
        predictor = self._setup.model  # the predictor that is stored in the setup
        frame.contact, frame.contact_flags = predictor.predict_with_flags(frame.charge_pC)
        if frame.warming_error_pC is not None:
            # An error of the warming changes the contact by half of the difference between the contacts of raised and
            # of lowered charges.
            changed_pC = frame.charge_pC + np.outer([1.0, -1.0], frame.warming_error_pC)  # shape (2, n_electrode)
            # `np.asarray` gives one row for each contact, which begins with x, y and the force.
            raised, lowered = np.asarray(predictor.predict_batch(changed_pC), float)[:, :3]
            contact_error = 0.5 * (raised - lowered)
            frame.contact = frame.contact.with_error(np.outer(contact_error, contact_error))


STAGES: tuple[type[Stage], ...] = (
    Gain,
    Hum,
    Tare,
    Integrator,
    Leak,
    Touch,
    Saturation,
    Warming,
    Prediction,
    FilmFollower,
    Tracker,
)
"""All stages in the order in which they process a frame. The device file and the export to C follow from the stages."""

DeviceSections = defstruct(
    "DeviceSections",
    [
        (stage.section, stage.rule_class | None, stage.rule_class() if stage.is_default else None)
        for stage in STAGES
        if stage.section
    ],
    bases=(Board,),
    frozen=True,
)
"""Content of a device file. Each stage with settings has a section."""


def create_stages(setup: Setup, *, needs_contact: bool = False) -> list[Stage]:
    """Create the stages of a stream that the settings require, in their order.

    Args:
        setup: Settings and objects that the stages share.
        needs_contact: Whether to create the stages that process contacts. Otherwise, the stages before them are
            created.

    Raises:
        DeviceError: If a setting states numbers for electrodes other than the given ones, or if warming must be
            estimated with too few electrodes.
        ModelError: If a stage cannot use the model.
    """
    return [stage(setup) for stage in STAGES if stage.needs_contact is needs_contact and stage.is_used(setup)]


def load_device(path: StrPath | None) -> Device:
    """Read a device file and return its settings, or return `ANY_BOARD` if the path is None.

    Raises:
        DeviceError: If the file cannot be read, or a key is unknown, missing or wrong.
    """
    if path is None:
        return ANY_BOARD
    return device_from_table(read_toml(path, "a device file", DeviceError, dict[str, Any]), str(path))


def device_from_table(table: Mapping[str, Any], where: str) -> Device:
    """Convert the content of a device file to the settings of a board.

    If the section `[frames]` has no key `format`, the format of the frames is `auto`. Every section with the settings
    of a stage becomes an object of a subclass of `Rule`. If such a section contains the key `on = false`, the stage is
    switched off, and the result has no settings for it.

    Args:
        table: Sections and keys of the file, as the docstring of this module describes them.
        where: Name of the file, for messages.

    Raises:
        DeviceError: If a key is unknown, missing or wrong.
    """
    frames = table.get("frames")
    complete_table = dict(table)
    if isinstance(frames, Mapping):  # `convert` adds a missing section, and reports an error if it is not a mapping
        complete_table["frames"] = {"format": "auto", **frames}
    sections: Any = convert(complete_table, DeviceSections, where, DeviceError)
    # Besides the name, the front end, the frames and the channels, each section has the settings of one stage. Each
    # stage finds its settings by their class.
    values = structs.asdict(sections).values()
    settings_by_class = {type(value): value for value in values if isinstance(value, Rule) and value.on}
    return Device(
        name=sections.name,
        front_end=sections.front_end,
        frames=sections.frames,
        channels=sections.channels,
        rules=settings_by_class,
        table=table,
        where=where,
    )


ANY_BOARD = device_from_table({}, "device")
"""Settings of a board that has no device file."""


def switched_on(device: Device, section: str) -> Device:
    """Return a copy of the settings of a board in which the stage of one section is switched on.

    The attribute `table` of the copy contains the same change, because recordings store this attribute.

    Args:
        device: The settings of the board, which are not changed.
        section: Name of the section. Its other keys keep their values.
    """
    changed_section = {**device.table.get(section, {}), "on": True}
    return device_from_table({**device.table, section: changed_section}, device.where)
