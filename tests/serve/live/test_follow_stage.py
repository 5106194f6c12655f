"""The stage that corrects contacts for the pretension of the film, with a follower that records its calls."""

from types import SimpleNamespace

import numpy as np
import pytest

from isocharge.serve import Contact, Frame, device_from_table
from isocharge.serve.live import device as device_module
from isocharge.serve.live.device import FollowFilm
from isocharge.serve.signal_chain.stage import Setup

CHARGE_pC = np.array([100.0, 200.0, 150.0, 130.0])
CONTACT = Contact(1.0, 2.0, 0.5, 0.1, 0.1, 0.01, 0.0)


@pytest.fixture
def stage(monkeypatch, predictor):
    """Return the stage, whose follower doubles each force."""
    follower = SimpleNamespace(
        film="calibrated",
        is_lost=False,
        observed=[],
        follow_contact=lambda contact, _: contact._replace(force_N=2.0 * contact.force_N),
    )

    def observe_frame(charge_pC, contact, flags, clock_s):
        follower.observed.append((charge_pC, contact, flags, clock_s))
        follower.film = "changed"

    follower.observe_frame = observe_frame
    monkeypatch.setattr(device_module, "FilmFollower", lambda *_: follower)
    setup = Setup(predictor.metadata.electrodes, device_from_table({"follow": {"on": True}}, "board"), predictor)
    return SimpleNamespace(step=FollowFilm(setup).step, follower=follower)


def frame_with(contact, *, is_valid=True):
    return Frame(
        1,
        None,
        tuple(CHARGE_pC),
        charge_pC=CHARGE_pC if is_valid else None,
        contact=contact,
        is_valid=is_valid,
        clock_s=3.0,
        flags=["drift"],
    )


def test_contact_is_corrected_before_its_frame_changes_the_estimate(stage):
    frame = frame_with(CONTACT)
    stage.step(frame)
    assert (frame.contact.force_N, frame.film, frame.flags) == (1.0, "calibrated", ["drift"])
    ((charge_pC, contact, flags, clock_s),) = stage.follower.observed
    assert (charge_pC is CHARGE_pC, contact.force_N, flags[0], clock_s) == (True, 1.0, "drift", 3.0)


@pytest.mark.parametrize(("contact", "flags"), [(CONTACT, ["drift", "film"]), (None, ["drift"])])
def test_only_contacts_are_flagged_while_the_film_cannot_be_followed(stage, contact, flags):
    stage.follower.is_lost = True
    frame = frame_with(contact)
    stage.step(frame)
    assert frame.flags == flags


def test_invalid_frame_is_not_observed(stage):
    """It does not show whether the touch has ended."""
    stage.step(frame_with(None, is_valid=False))
    assert stage.follower.observed == []
