"""A press session, closed: a board on a pseudo-terminal is pressed where the dialogue asks, by nobody."""

import os
import queue
import re
import threading
import time

import numpy as np
import pytest

from isocharge.cli.train.press_dialogue import QUESTION, Dialogue, PressEvents, Screen
from isocharge.serve import Frame, Port, PressWatch, ReadingStream, encode_frame
from isocharge.serve.virtual_sensor.pseudo_port import PseudoPort
from isocharge.simulate import Circle, load_sensor
from isocharge.train import CalibrationProblem, PressSession

pytestmark = pytest.mark.xdist_group("clock")

RATE_HZ = 200.0
NAMES = ("A", "B", "C", "D")
TARED = 400
"""Frames before the first press: the tare takes half of them."""

SPEED = 5.0
"""How many times as fast as its own clock says the board sends."""

pytestmark = pytest.mark.xdist_group("clock")


class Rig(threading.Thread):
    """A board with a machine: presses where it is told for a second, and answers Enter when it is asked."""

    def __init__(self, charges, parameters):
        super().__init__(daemon=True)
        self.port, self.orders, self.stop = PseudoPort(), queue.Queue(), threading.Event()
        self._charges, self._parameters, self._rng = charges, parameters, np.random.default_rng(1)
        self.pressed = []

    def run(self):
        start = time.perf_counter()
        for frame, charge in enumerate(self._played()):
            self.stop.wait(max(0.0, start + frame / (SPEED * RATE_HZ) - time.perf_counter()))
            if self.stop.is_set():
                break
            noisy = charge + np.hypot(1.0, 0.002 * charge) * self._rng.standard_normal(4) + 7.0
            self.port.write_whole(encode_frame(Frame(frame % 65536, round(1e6 * frame / RATE_HZ), tuple(noisy))))

    def _played(self):
        yield from np.zeros((TARED, 4))
        while True:
            yield from np.zeros((100, 4))
            try:
                contact = self.orders.get_nowait()
            except queue.Empty:
                continue
            self.pressed.append(contact)
            yield from np.repeat(self._charges.charges(self._parameters, contact[None]), 200, axis=0)


class RiggedScreen(Screen):
    """Reads what is proposed, and answers what is asked."""

    def __init__(self, keyboard):
        super().__init__(NAMES)
        self.keyboard, self.proposed = keyboard, None

    def say(self, sentence):
        super().say(sentence)
        if press := re.search(r"Press (\S+) N at \((\S+), (\S+)\) mm and hold", sentence):
            self.proposed = np.array([float(press[2]), float(press[3]), float(press[1])])
        if sentence == QUESTION:
            os.write(self.keyboard, b"\n")


class RiggedEvents(PressEvents):
    """Orders what is proposed when only new presses count; ends after the last."""

    def order(self, rig, screen, most):
        self.rig, self.screen, self.most = rig, screen, most

    def arm(self):
        super().arm()
        if len(self.rig.pressed) == self.most:
            os.write(self.screen.keyboard, b"q\n")
        else:
            self.rig.orders.put(self.screen.proposed)


def test_a_film_that_nobody_knows_is_known_after_some_presses(capsys):
    """Three presses."""
    count = 3
    problem = CalibrationProblem.of(load_sensor("four-25um-biaxial"), Circle(1.0))
    charges = problem.charges
    parameters = charges.prior.draw(np.random.default_rng(11), 1)[0]
    session = PressSession(problem, save=lambda _: None, until=0.0)
    rig = Rig(charges, parameters)
    answers, keyboard = os.pipe()
    rig.start()
    try:
        with (
            Port(rig.port.url, silence_s=30.0) as port,
            RiggedEvents(port, ReadingStream(NAMES), PressWatch(NAMES), answers) as events,
        ):
            screen = RiggedScreen(keyboard)
            events.order(rig, screen, count)
            Dialogue(session, events, screen, lambda *_: None).with_person()
    finally:
        rig.stop.set()
        rig.join()
        rig.port.close()
        os.close(answers)
        os.close(keyboard)
    said = capsys.readouterr().err
    np.testing.assert_allclose(session.presses.contact, rig.pressed, err_msg=said)
    clean = charges.charges(parameters, session.presses.contact)
    assert (np.abs(session.presses.charge_pC - clean) < 5 * np.hypot(1.0, 0.002 * clean) * 0.2).all()
    deviation = (session.result.posterior.parameters - parameters) / charges.prior.std
    assert deviation @ np.linalg.solve(session.result.posterior.covariance, deviation) < 40.0  # 13 parameters
    assert session.result.left.position_mm < 0.3
    assert said.count("are left by not knowing the film") == count - 1
