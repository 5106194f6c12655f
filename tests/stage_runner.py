"""Stages that process frames without a board and without a model."""

from types import SimpleNamespace

import numpy as np
from msgspec import structs

from isocharge.serve import Chunk, Frame, TouchStream, device_from_table, encode_frame
from isocharge.serve.flags import INVALID
from isocharge.serve.frames.frame import SATURATED_BIT
from isocharge.serve.live.device import create_stages
from isocharge.serve.record.record import flags_in_order
from isocharge.serve.signal_chain.stage import Device, Setup
from isocharge.serve.tracking.tracker import Tracker, TrackRule


class StageRunner:
    """The stages of a board that compute touch charges.

    Args:
        n_electrode: Number of electrodes, which are called A, B, C and so on.
        misfit: Function from charges, shape (n, n_electrode), to misfits, for the estimate of warming.
        sections: Sections of the device file.
    """

    def __init__(self, n_electrode=3, misfit=None, **sections):
        device = sections.pop("device", None) or device_from_table(sections, "b")
        predictor = None
        if misfit is not None:
            predictor = SimpleNamespace(predict_batch=lambda charge_pC: SimpleNamespace(misfit=misfit(charge_pC)))
            predictor.for_measured_noise = lambda _: predictor
        self.stages = create_stages(Setup(tuple("ABCDEFGH"[:n_electrode]), device, predictor))

    def advance(self, values, t_s, dt_s, *, limited=False, flags=()):
        """Process a frame, and return it with its flags in their order."""
        frame = Frame(None, None, tuple(np.asarray(values).tolist()), SATURATED_BIT if limited else 0)
        frame.clock_s = t_s
        frame.dt_s = dt_s
        frame.flags = list(flags)
        for stage in self.stages:
            stage.step(frame)
        frame.flags = flags_in_order(frame.flags)
        return frame

    def run(self, rows, rate_Hz, together=0):
        """Process rows of charges, shape (n, n_electrode), pC, that arrive at a rate, and return the frames.

        The times between the first `together` frames are not known.
        """
        return [self.advance(row, i / rate_Hz, (i >= together) / rate_Hz) for i, row in enumerate(rows)]

    def reset_tare(self):
        """Measure the tare again."""
        for stage in self.stages:
            stage.reset()

    def stage(self, stage_class):
        """Return the stage of a class."""
        (found,) = [stage for stage in self.stages if isinstance(stage, stage_class)]
        return found


def charges_and_contacts(frames):
    """Return the touch charges of n frames, shape (n, n_electrode), pC, NaN before the tare, and whether they touch."""
    charges = [np.full(len(frame.values), np.nan) if frame.charge_pC is None else frame.charge_pC for frame in frames]
    return np.array(charges), np.array([frame.is_contact for frame in frames])


def new_tracker(**settings):
    """Return a tracker with settings of the section `[track]`."""
    return Tracker(Setup((), Device(rules={TrackRule: TrackRule(**settings)})))


def track(tracker, contact, t_s, flags=(), charge_pC=None):
    """Process a frame with a tracker, and return the tracked contact and the event."""
    frame = Frame(None, None, (), flags=list(flags), charge_pC=charge_pC, contact=contact)
    frame.dt_s = t_s - tracker._time_s
    frame.is_valid = INVALID not in flags
    tracker.step(frame)
    return frame.tracked, frame.event


def recorded_lines(predictor, rows, table, requests=None):
    """Return the records of a stream of charges at 1 kHz as lines of JSON.

    Args:
        predictor: The model.
        rows: Charges of the frames, shape (n, n_electrode), pC.
        table: Sections of the device file, in addition to `[tare]`.
        requests: Functions that are called with the stream before the frames with some numbers.
    """
    touch = TouchStream(predictor, device_from_table({"tare": {"frames": 10}} | table, "b"))
    lines = []
    for number, row in enumerate(rows.tolist()):
        if number in (requests or {}):
            requests[number](touch)
        chunk = Chunk(encode_frame(Frame(number, 1000 * number, tuple(row))), 5.0 + 1e-3 * number, 0)
        lines += [structs.replace(record, latency_us=0.0).to_json() for record in touch.feed(chunk)]
    return lines
