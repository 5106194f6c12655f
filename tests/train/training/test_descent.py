"""The loop of first-order training: the best network is kept, and a stage without a better one ends early."""

import pytest
import torch

from isocharge.common.errors import TrainingError
from isocharge.common.progress import listening
from isocharge.common.resumable_run import resume_parts
from isocharge.train.training import descent
from isocharge.train.training.descent import Descent, TrainingStage
from isocharge.train.training.network import Perceptron

REPORT_EVERY = 20


@pytest.fixture(autouse=True)
def _short_reports(monkeypatch):
    monkeypatch.setattr(descent, "REPORT_EVERY", REPORT_EVERY)
    monkeypatch.setattr(descent, "SAVE_EVERY_S", 0.0)


def stage(scores, steps=20 * REPORT_EVERY, warm_up_steps=0):
    """A small network that is pulled to a target, with given scores at successive evaluations."""
    torch.manual_seed(0)
    part, given, seen = Perceptron(2, (4, 4), 1), iter(scores), []

    def loss(_, random):
        inputs = torch.rand(8, 2, generator=random)
        return ((part(inputs) - inputs.sum(dim=1, keepdim=True)) ** 2).mean()

    def score():
        seen.append({name: values.clone() for name, values in part.state_dict().items()})
        return next(given), "text"

    return TrainingStage("stage", part, loss, score, steps, warm_up_steps), seen


def run(made, patience=10**6):
    calls = []
    with listening(lambda _, done, *rest: calls.append((done, *rest))):
        Descent(made, 1e-2, patience, seed=0).run()
    return calls


def same(one, other):
    return all(torch.equal(one[name], other[name]) for name in one)


def test_the_best_network_is_kept():
    made, seen = stage([3.0, 1.0, 2.0, 4.0], steps=4 * REPORT_EVERY)
    run(made)
    assert same(made.part.state_dict(), seen[1])
    assert not same(seen[1], seen[3])


def test_it_ends_when_nothing_better_has_come_for_long():
    made, seen = stage([5.0, 2.0, *[3.0] * 18])
    calls = run(made, patience=3 * REPORT_EVERY)
    assert [step for step, *_ in calls] == [REPORT_EVERY * k for k in (1, 2, 3, 4, 5)]
    assert same(made.part.state_dict(), seen[1])
    assert calls[0][1] == 20 * REPORT_EVERY
    assert calls[0][2].startswith("loss ")
    assert calls[0][2].endswith("text")


def test_nothing_counts_while_another_loss_is_trained():
    made, seen = stage([0.0, 0.0, 2.0, 3.0], steps=4 * REPORT_EVERY, warm_up_steps=2 * REPORT_EVERY)
    run(made, patience=REPORT_EVERY + 1)
    assert same(made.part.state_dict(), seen[2])


def test_it_learns():
    made, _ = stage(range(30, 0, -1), steps=30 * REPORT_EVERY)
    run(made)
    inputs = torch.rand(50, 2)
    assert torch.allclose(made.part(inputs), inputs.sum(dim=1, keepdim=True), atol=0.04)


def test_a_score_that_is_no_number_is_an_error():
    made, _ = stage([float("nan")] * 20)
    with pytest.raises(TrainingError, match=r"the stage loss is .* at step 20 of 400; lower training.learning_rate"):
        run(made)


class Killed(BaseException):
    """As sudden as a SIGKILL, but caught by the test."""


def test_a_killed_descent_ends_with_the_same_weights(tmp_path):
    """Killed in the middle, with the best network already behind it: weights, optimisers, draws and best go on."""
    scores = [9.0, 1.0, 5.0, 4.0, 3.0]

    def kill(_, done, *__):
        if done == 3 * REPORT_EVERY:
            raise Killed

    broken, _ = stage(scores, steps=5 * REPORT_EVERY)
    with pytest.raises(Killed), listening(kill), resume_parts(tmp_path / "it", {}) as kept:
        Descent(broken, 1e-2, 10**6, seed=0).run(kept)
    resumed, seen = stage(scores[2:], steps=5 * REPORT_EVERY)
    whole, expected = stage(scores, steps=5 * REPORT_EVERY)
    with resume_parts(tmp_path / "it", {}) as kept:
        Descent(resumed, 1e-2, 10**6, seed=0).run(kept)
    Descent(whole, 1e-2, 10**6, seed=0).run()
    assert len(seen) == 3
    assert same(seen[-1], expected[-1])
    assert same(resumed.part.state_dict(), expected[1])
