"""Films and their viewers: takes what the readers send, and gives each viewer as much of it as it can show.

A viewer confirms what it has drawn. It gets the next samples only then, coalesced with all that came meanwhile: nothing
is queued for a viewer that is slow, and a stalled one costs nothing.
"""

import asyncio
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from isocharge.serve.viewer.coalesce import coalesce
from isocharge.serve.viewer.link import PageEnd
from isocharge.serve.viewer.messages import LIVE_ACTIONS, REPLAY_ACTIONS, PageRequest, samples_message
from isocharge.serve.viewer.playhead import Playhead
from isocharge.serve.viewer.sample import SampleFormat
from isocharge.serve.viewer.tape import LiveTape, RecordedTape, Tape

TICK_S, IDLE_S = 1 / 120, 0.05
"""Time between two looks at the readers, s: with viewers, and without."""

IN_FLIGHT = 2
"""Messages of a film that a viewer may have without having drawn them."""

SHOWN_HZ = 240.0
"""Samples of a second that a viewer gets at most, Hz: four for each picture."""

FEWEST, MOST = 8, 600
"""Bounds of the samples in one message."""

BACKFILL_S = 10.0
"""How far back a new viewer sees, s: the length of the traces."""

MARKERS = 200
"""Markers that the page shows, the latest."""

STATE_S = 0.5
"""Time between two looks at how far a recording is known, s."""


@dataclass
class Film:
    """A film on the page.

    Attributes:
        number: Its place on the page, from 0.
        link: To the process that reads its port.
        format: Of its samples.
        tape: The samples.
        description: For the page, see `describe_film`.
        state: What changes seldom: counters, recording, notes; for the page.
        version: Counts the changes of `state`.
    """

    number: int
    link: PageEnd
    format: SampleFormat
    tape: Tape
    description: dict[str, Any]
    state: dict[str, Any] = field(default_factory=dict)
    version: int = 0

    def close(self) -> None:
        """Close the link and the file of a recording."""
        self.link.close_here()
        if isinstance(self.tape, RecordedTape):
            self.tape.close()

    def drain(self) -> None:
        """Take what the reader has sent."""
        if not self.link.is_open:
            return
        if data := self.link.take(self.format.dtype.itemsize):
            self.tape.append(np.frombuffer(data, self.format.dtype))
        for message in self.link.replies():
            self._note(message)
        if not self.link.is_open:
            self._note({"has_ended": True})

    def show_progress(self) -> None:
        """Bring the state of a recording up to date."""
        if isinstance(self.tape, RecordedTape) and self.state.get("samples") != self.tape.total:
            self._note({"samples": self.tape.total, "span": self.tape.span(), "overview": self.tape.overview()})

    def _note(self, message: dict[str, Any]) -> None:
        marker = message.pop("marker", None)
        if marker is not None:
            self.state["markers"] = [*self.state.get("markers", ()), marker][-MARKERS:]
        self.state.update(message)
        self.version += 1


class Viewer:
    """One browser: what it has of each film.

    Attributes:
        wake: Set when there may be something to send.
        playhead: Its place in a recording; None for live films.
    """

    def __init__(self, films: list[Film], now_s: float) -> None:
        self.wake = asyncio.Event()
        self.playhead = Playhead() if any(isinstance(film.tape, RecordedTape) for film in films) else None
        self._films = films
        self._next = [film.tape.index(now_s - BACKFILL_S) for film in films]
        self._begins = [True for _ in films]
        self._missed = [0 for _ in films]
        self._versions = [-1 for _ in films]
        self._sent = self._confirmed = 0
        self._served_s = self._played_s = now_s
        self._shows_playhead = True

    def confirm(self, number: int) -> None:
        """The page has drawn a message."""
        self._confirmed = max(self._confirmed, min(number, self._sent))
        self.wake.set()

    def apply(self, request: PageRequest) -> None:
        """Do what the page asks for with its place in the recording."""
        if self.playhead is not None:
            self.playhead.apply(request, self._length_s())
            self._shows_playhead = True

    def messages(self, now_s: float) -> list[bytes | str]:
        """What to send now; nothing as long as the viewer has not drawn what it has.

        Args:
            now_s: Unix seconds.
        """
        if self.playhead is not None:
            self._play(now_s)
        if self._sent - self._confirmed >= IN_FLIGHT * len(self._films):
            return []
        elapsed_s, self._served_s = now_s - self._served_s, now_s
        most = int(min(max(SHOWN_HZ * elapsed_s, FEWEST), MOST))
        parts = [part for film in self._films for part in self._film_messages(film, most, now_s)]
        if self.playhead is not None and self._shows_playhead:
            parts.append(json.dumps({"play": self.playhead.to_json()}))
            self._shows_playhead = False
        return parts

    def _film_messages(self, film: Film, most: int, now_s: float) -> list[bytes | str]:
        messages: list[bytes | str] = []
        if self._versions[film.number] != film.version:
            self._versions[film.number] = film.version
            messages.append(json.dumps({"film": film.number, "state": film.state}))
        if (samples := self._samples(film, most, now_s)) is not None:
            messages.append(samples)
        return messages

    def _samples(self, film: Film, most: int, now_s: float) -> bytes | None:
        """The next samples of a film, or None if it has nothing new."""
        stop, start = self._stop(film), max(self._next[film.number], film.tape.oldest)
        begins, self._begins[film.number] = self._begins[film.number], False
        if stop <= start and not begins:
            return None
        self._missed[film.number] += start - self._next[film.number]
        self._next[film.number] = stop
        self._sent += 1
        shown = coalesce(film.tape.samples(start, stop), MOST if begins else most)
        return samples_message(film.number, self._sent, now_s, shown, self._missed[film.number], begin_anew=begins)

    def _stop(self, film: Film) -> int:
        """Number of the first sample that is not to be shown yet."""
        if self.playhead is None or not isinstance(film.tape, RecordedTape) or not film.tape.total:
            return film.tape.total
        at_s = film.tape.span()[0] + self.playhead.at_s
        stop = film.tape.index(at_s)
        if self.playhead.has_jumped:
            self.playhead.has_jumped, self._begins[film.number] = False, True
            self._next[film.number] = film.tape.index(at_s - BACKFILL_S)
        return stop

    def _play(self, now_s: float) -> None:
        assert self.playhead is not None
        step_s, self._played_s = now_s - self._played_s, now_s
        is_complete = all(film.state.get("is_complete", False) for film in self._films)
        self._shows_playhead |= self.playhead.advance(max(step_s, 0.0), self._length_s(), is_complete=is_complete)

    def _length_s(self) -> float:
        spans = [film.tape.span() for film in self._films if isinstance(film.tape, RecordedTape)]
        return max((end - start for start, end in spans), default=0.0)


class Hub:
    """All films and viewers; belongs to one event loop.

    Attributes:
        films: In their order on the page.
        is_replay: Whether the films are recordings.
    """

    def __init__(self, films: list[Film], clock: Callable[[], float] = time.time) -> None:
        self.films = films
        self.is_replay = any(isinstance(film.tape, RecordedTape) for film in films)
        self.actions = REPLAY_ACTIONS if self.is_replay else LIVE_ACTIONS
        self.clock = clock
        self._viewers: set[Viewer] = set()

    @property
    def viewers(self) -> int:
        """How many there are."""
        return len(self._viewers)

    def close(self) -> None:
        """Close all films."""
        for film in self.films:
            film.close()

    def join(self) -> Viewer:
        """A new viewer."""
        viewer = Viewer(self.films, self.clock())
        self._viewers.add(viewer)
        return viewer

    def leave(self, viewer: Viewer) -> None:
        """A viewer has gone."""
        self._viewers.discard(viewer)

    def do(self, request: PageRequest, viewer: Viewer) -> bool:
        """Do what a page asks for; False if the reader of the film takes no requests any more."""
        if self.is_replay:
            viewer.apply(request)
            return True
        link = self.films[request.film].link
        return link.ask(do=request.action, on=request.is_on, text=request.text)

    async def run(self) -> None:
        """Take what comes, and wake the viewers, until all readers have ended."""
        looked_s = 0.0
        while any(film.link.is_open for film in self.films):
            for film in self.films:
                film.drain()
            if self.is_replay and self.clock() - looked_s > STATE_S:
                looked_s = self.clock()
                for film in self.films:
                    film.show_progress()
            for viewer in self._viewers:
                viewer.wake.set()
            await asyncio.sleep(TICK_S if self._viewers else IDLE_S)


def make_film(number: int, link: PageEnd, description: dict[str, Any], *, is_recording: bool) -> Film:
    """A film of which nothing has come yet."""
    samples = SampleFormat(tuple(description["electrodes"]))
    tape: Tape = RecordedTape(samples.dtype) if is_recording else LiveTape(samples.dtype)
    return Film(number, link, samples, tape, description)
