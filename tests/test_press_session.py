"""A press session, closed: a machine presses where the dialogue asks, and answers that it did."""

import os
import re
from queue import Queue

import numpy as np

from isocharge.cli.train.press_dialogue import QUESTION, Dialogue, PressEvents, Screen
from isocharge.serve import Chunk, Frame, PressWatch, ReadingStream, encode_frame
from isocharge.simulate import Circle, load_sensor
from isocharge.train import CalibrationProblem, PressSession

RATE_HZ = 200.0
NAMES = ("A", "B", "C", "D")
TARED = 400
"""Frames before the first press: the tare takes half of them."""


class Machine:
    """Presses where it is told for a second, and presses Enter when it is asked.

    Attributes:
        orders: Contacts to press at, None for the end.
        pressed: Where it pressed.
    """

    def __init__(self, film):
        self.film, self.orders, self.pressed = film, Queue(), []
        self.answers, self.keyboard = os.pipe()

    def type(self, line):
        os.write(self.keyboard, f"{line}\n".encode())

    def chunks(self):
        """What its board sends: it waits for an order before every press, so no clock is needed."""
        rng = np.random.default_rng(1)
        for frame, charge in enumerate(self.rows()):
            noisy = charge + np.hypot(1.0, 0.002 * charge) * rng.standard_normal(4) + 7.0
            yield Chunk(encode_frame(Frame(frame, round(1e6 * frame / RATE_HZ), tuple(noisy))), frame / RATE_HZ, 0)

    def rows(self):
        yield from np.zeros((TARED, 4))
        while (contact := self.orders.get()) is not None:
            self.pressed.append(contact)
            yield from np.zeros((100, 4))
            yield from np.repeat(self.film.charges(contact[None]), 200, axis=0)
            yield from np.zeros((100, 4))


class ReadScreen(Screen):
    """Reads what is proposed, and answers what is asked."""

    def __init__(self, machine):
        super().__init__(NAMES)
        self.machine, self.proposed = machine, None

    def say(self, sentence):
        super().say(sentence)
        if press := re.search(r"Press (\S+) N at \((\S+), (\S+)\) mm and hold", sentence):
            self.proposed = np.array([float(press[2]), float(press[3]), float(press[1])])
        if sentence == QUESTION:
            self.machine.type("")


class OrderedEvents(PressEvents):
    """Orders what is proposed when only new presses count; ends after the third."""

    def arm(self):
        super().arm()
        if len(self.machine.pressed) == 3:
            self.machine.type("q")
            self.machine.orders.put(None)
        else:
            self.machine.orders.put(self.screen.proposed)


def test_a_film_that_nobody_knows_is_known_after_some_presses(capsys):
    problem = CalibrationProblem.of(load_sensor("four-25um-biaxial"), Circle(1.0))
    parameters = problem.prior.draw(np.random.default_rng(11), 1)[0]
    machine = Machine(problem.charges.forward_map(parameters))
    session = PressSession(problem, save=lambda _: None, until=0.0)
    screen = ReadScreen(machine)
    with OrderedEvents(machine.chunks(), ReadingStream(NAMES), PressWatch(NAMES), machine.answers) as events:
        events.machine, events.screen = machine, screen
        Dialogue(session, events, screen, lambda *_: None).with_person()
    said = capsys.readouterr().err
    np.testing.assert_allclose(session.presses.contact, machine.pressed, err_msg=said)
    clean = machine.film.charges(session.presses.contact)
    assert (np.abs(session.presses.charge_pC - clean) < 5 * np.hypot(1.0, 0.002 * clean) * 0.2).all()
    deviation = (session.result.posterior.parameters - parameters) / problem.prior.std
    assert deviation @ np.linalg.solve(session.result.posterior.covariance, deviation) < 40.0  # 13 parameters
    assert session.result.left.position_mm < 0.3
    assert said.count("are left by not knowing the film") == 2
