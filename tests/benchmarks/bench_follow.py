"""How well a film is followed: films that changed, and unchanged films that warm fingers touch.

    python tests/benchmarks/bench_follow.py [--sensor four-25um-biaxial] [--films 6] [--sessions 1] [--seed 0]
        [--frames 10] [--seconds 10] [--offsets none,constant,varying,decaying] [--json]

Each film is drawn from the prior, with a pretension of 1 MPa, and calibrated by 20 presses. A session is 60 or 120
touches of unknown place and force, 5 s apart. No touch makes the film yield. During the given number of frames, the
force of a touch is constant, and each frame has its own noise.

Changed films: root-mean-square errors of the contacts after 60 touches, the share of forces within two reported
standard deviations, the errors by the calibrated model, and the share of touches with the flag `film`.

Unchanged films: an offset is added to all charges of the session. `held` is the share of the sessions after which the
followed pretension is within two reported standard deviations of the calibrated one, or the film is flagged. `wrong` is
the share of the ten next touches, without an offset, that have an error of more than four reported standard deviations
and no flag.

The benchmark also measures the time of a frame with and without following, for the given number of seconds.
"""

import time
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from measured_films import measured_presses, with_rig_errors
from shared import arguments, in_turns, print_results, report_progress

from isocharge.common.contact_errors import position_error
from isocharge.common.statistics import rms
from isocharge.serve import (
    Chunk,
    Contact,
    Frame,
    Predictor,
    TouchStream,
    device_from_table,
    encode_frame,
)
from isocharge.serve.benchmark import Contender
from isocharge.serve.tracking.film_follower import FilmFollower
from isocharge.simulate import Circle, ForwardMap, load_sensor
from isocharge.train import CalibrationProblem, calibrate, write_calibration
from isocharge.train.data.presses import draw_contacts

PRETENSION_MPa = 1.0
CHANGES_MPa = (0.0, 0.35, -0.35, -0.45, 0.8)
"""Changes of the pretension. A film that is 1 K warmer than its ring loses 0.4 to 0.55 MPa."""

OFFSETS_pC = (3.0, -3.0, 10.0, -10.0, 30.0, -30.0, 100.0, -100.0)
TOUCH_INTERVAL_s = 5.0
WARM_FINGER_s = 150.0
COLD_TOUCHES = 10
PRESSES = 20
RATE_Hz = 200.0
SEQ_MODULUS = 65536
"""Number of values of the counter of a binary frame."""

TARE_FRAMES = 110
TOUCH_FRAMES = 20
REST_FRAMES = 20
CONTACTS = 300
"""Contacts by which the errors after a session are measured."""


class Film(NamedTuple):
    """A calibrated film: its problem, its model, and its forward map by the change of its pretension, MPa."""

    problem: CalibrationProblem
    predictor: Predictor
    maps: dict[float, ForwardMap]

    def touches(self, change_MPa: float, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw contacts below the yield force, shape (n, 3), and their noisy charges, shape (n, n_electrode), pC."""
        contact, frames = self.touch_frames(change_MPa, count, 1, rng)
        return contact, frames[:, 0]

    def touch_frames(
        self, change_MPa: float, count: int, frame_count: int, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Draw contacts below the yield force, and the noisy charges of several frames of each contact.

        Returns:
            Contacts, shape (n, 3), and charges, shape (n, n_frame, n_electrode), pC.
        """
        contact = draw_contacts(rng, self.problem.domain, count)
        contact[:, 2] = np.minimum(contact[:, 2], 0.95 * self.predictor.validity.yield_force_N)
        return contact, noisy_frames(self.problem, self.maps[change_MPa].charges(contact), frame_count, rng)


def calibrated_film(sensor: str, seed: int, folder: Path) -> Film:
    """Draw a film, and calibrate it."""
    problem = CalibrationProblem.of(load_sensor(sensor), Circle(1.0))
    rng = np.random.default_rng([seed, 11])
    parameters = problem.prior.draw(rng, 1)[0]
    maps = {}
    for change_MPa in CHANGES_MPa:
        parameters[0] = PRETENSION_MPa + change_MPa
        maps[change_MPa] = problem.charges.forward_map(parameters.copy())
    contact = draw_contacts(rng, problem.domain, PRESSES)
    charge = problem.noise.add(maps[0.0].charges(contact), rng)
    presses = measured_presses(problem, with_rig_errors(contact, rng), charge)
    write_calibration(calibrate(presses, problem), folder / "mine")
    return Film(problem, Predictor(folder / "mine"), maps)


def noisy_frames(
    problem: CalibrationProblem, charge: np.ndarray, frame_count: int, rng: np.random.Generator
) -> np.ndarray:
    """Return frames of touches with constant charges, each frame with its own noise.

    Args:
        problem: The films, which state the noise.
        charge: Charges of the touches without noise, shape (n, n_electrode), pC.
        frame_count: Number of frames of each touch.
        rng: Generator of the noise.

    Returns:
        Charges with noise, shape (n, n_frame, n_electrode), pC.
    """
    return problem.noise.add(np.repeat(charge[:, None], frame_count, axis=1), rng)


def session_offsets(kind: str, size_pC: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return the offset of each touch of a session, shape (count,), pC."""
    if kind == "varying":
        return size_pC * (1.0 + 0.5 * rng.standard_normal(count))
    if kind == "decaying":
        return size_pC * np.exp(-TOUCH_INTERVAL_s * np.arange(count) / WARM_FINGER_s)
    return np.full(count, size_pC)


def observe(follower: FilmFollower, touches: np.ndarray) -> tuple[float, list[float]]:
    """Let a follower observe touches.

    Args:
        follower: The follower.
        touches: Charges of the frames of each touch, shape (n, n_frame, n_electrode), pC.

    Returns:
        Share of the touches with the flag `film`, and the time of the update after each touch, s.
    """
    flagged = 0
    times = []
    for number, frames in enumerate(touches):
        clock_s = TOUCH_INTERVAL_s * number
        for charge in frames:
            contact = follower.predictor.predict(charge)
            follower.observe_frame(charge, contact, follower.predictor.flags(contact), clock_s)
        begin = time.perf_counter()
        follower.observe_frame(None, None, (), clock_s + 1.0)
        times.append(time.perf_counter() - begin)
        flagged += follower.is_lost
    return flagged / len(touches), times


def answers(follower: FilmFollower, charges: np.ndarray) -> list[Contact]:
    """Return the contacts of charges on the followed film."""
    return [follower.follow_contact(follower.predictor.predict(charge), charge).contact for charge in charges]


def changed_film(film: Film, change_MPa: float, frame_count: int, seed: list[int]) -> dict[str, float]:
    """Errors after 60 touches of a film whose pretension changed."""
    rng = np.random.default_rng(seed)
    follower = FilmFollower(film.predictor)
    _, frames = film.touch_frames(change_MPa, 60, frame_count, rng)
    flagged, times = observe(follower, frames)
    contact, charge = film.touches(change_MPa, CONTACTS, rng)
    calibrated_contact = np.array(film.predictor.predict_batch(charge))[:, :3]
    answer = answers(follower, charge)
    force_error = np.array([one.force_N for one in answer]) - contact[:, 2]
    force_std = np.array([one.force_std_N for one in answer])
    return {
        "position_mm": rms(position_error(np.array([one[:3] for one in answer]), contact)),
        "force_percent": 100.0 * rms(force_error / contact[:, 2]),
        "force_coverage": float(np.mean(np.abs(force_error) < 2.0 * force_std)),
        "calibrated_position_mm": rms(position_error(calibrated_contact, contact)),
        "calibrated_force_percent": 100.0 * rms(calibrated_contact[:, 2] / contact[:, 2] - 1.0),
        "flagged": flagged,
        "touch_ms": 1e3 * float(np.median(times)),
    }


def warm_session(
    film: Film, kind: str, size_pC: float, count: int, frame_count: int, seed: list[int]
) -> dict[str, float]:
    """What an offset of the charges does to an unchanged film."""
    rng = np.random.default_rng(seed)
    follower = FilmFollower(film.predictor)
    calibrated_MPa = follower.film.pretension_MPa
    contact, frames = film.touch_frames(0.0, count + COLD_TOUCHES, frame_count, rng)
    observe(follower, frames[:count] + session_offsets(kind, size_pC, count, rng)[:, None, None])
    change_MPa = abs(follower.film.pretension_MPa - calibrated_MPa)
    is_flagged = follower.is_lost
    wrong = 0
    for truth, touch in zip(contact[count:], frames[count:], strict=True):
        (answer,) = answers(follower, touch[:1])  # the contact of the first frame of the touch
        std = np.array([answer.x_std_mm, answer.y_std_mm, answer.force_std_N])
        is_wrong = bool((np.abs(np.array(answer[:3]) - truth) > 4.0 * std).any())
        wrong += is_wrong and not follower.is_lost and not follower.predictor.flags(answer)
        observe(follower, touch[None])
    return {
        "held": float(is_flagged or change_MPa < 2.0 * follower.film.pretension_std_MPa),
        "flagged": float(is_flagged),
        "moved_MPa": change_MPa,
        "wrong": wrong / COLD_TOUCHES,
    }


class Board:
    """A live stream, and the frames that a board sends to it.

    Attributes:
        stream: The live stream.
    """

    def __init__(self, predictor: Predictor, device: dict[str, Any], rng: np.random.Generator) -> None:
        """Create the stream of a device file, and send frames without a touch until the tare is measured."""
        self.stream = TouchStream(predictor, device_from_table(device, "bench_follow"))
        self._rng = rng
        self._count = 0
        self.send(np.zeros(len(predictor.metadata.electrodes)), TARE_FRAMES)

    def send(self, charge: np.ndarray, count: int = 1) -> None:
        """Send frames with the same charges, shape (n_electrode,), pC, and with noise of 1 pC."""
        for _ in range(count):
            noisy_charge = charge + self._rng.standard_normal(charge.size)
            counter = self._count % SEQ_MODULUS  # a fast machine sends more frames than the counter has values
            frame = Frame(counter, int(1e6 * self._count / RATE_Hz), tuple(noisy_charge.tolist()))
            chunk = Chunk(encode_frame(frame), 1.7e9 + self._count / RATE_Hz, 0)
            self._count += 1
            for _record in self.stream.feed(chunk):
                pass


def frame_times(film: Film, seconds: float) -> list[dict[str, Any]]:
    """Measure the time of a frame of a held contact on the changed film, with and without following.

    Returns:
        Percentiles of the times, and their ratio to those of a stream without following.
    """
    rng = np.random.default_rng(12)
    _, charge = film.touches(0.35, 30, rng)
    boards = [Board(film.predictor, device, rng) for device in ({}, {"follow": {"on": True}})]
    for board in boards:
        for row in charge:
            board.send(row, TOUCH_FRAMES)
            board.send(np.zeros(row.size), REST_FRAMES)
    held = film.maps[0.35].charges(np.array([[3.0, 2.0, 0.5]]))[0]
    calls = [partial(board.send, held) for board in boards]
    contenders = [Contender(name, 1, call) for name, call in zip(("not followed", "followed"), calls, strict=True)]
    return in_turns(contenders, seconds)


def mean(rows: list[dict[str, float]]) -> dict[str, float]:
    """Return the means over films and sessions."""
    return {key: round(float(np.mean([row[key] for row in rows])), 4) for key in rows[0]}


def main() -> None:
    asked = arguments(
        __doc__,
        sensor="four-25um-biaxial",
        films=6,
        sessions=1,
        seed=0,
        frames=10,
        seconds=10.0,
        offsets="none,constant,varying,decaying",
        json=False,
    )
    results = {}

    def add(title: str, rows: list[dict[str, float]]) -> None:
        """Add the mean of rows to the results, and print it."""
        results[title] = mean(rows)
        report_progress(title, results[title])

    with TemporaryDirectory() as folder:
        films = [calibrated_film(asked.sensor, seed, Path(folder) / str(seed)) for seed in range(asked.films)]
        seeds = [(film, [asked.seed, number, n]) for n, film in enumerate(films) for number in range(asked.sessions)]
        for kind in asked.offsets.split(","):
            if kind == "none":
                results["frame of a held contact"] = frame_times(films[0], asked.seconds)
                for change_MPa in CHANGES_MPa:
                    rows = [changed_film(film, change_MPa, asked.frames, seed) for film, seed in seeds]
                    add(f"changed by {change_MPa:+g} MPa", rows)
            for size_pC in (0.0,) if kind == "none" else OFFSETS_pC:
                for count in (60, 120):
                    rows = [warm_session(film, kind, size_pC, count, asked.frames, seed) for film, seed in seeds]
                    add(f"{kind} {size_pC:+g} pC, {count} touches", rows)
    print_results("follow", asked, results)


if __name__ == "__main__":
    main()
