"""The loop of first-order training: the best network is kept, and a stage without a better one ends early."""

import pytest
import torch

from isocharge.common.errors import TrainingError
from isocharge.train.training.checkpoint import Checkpoint
from isocharge.train.training.descent import REPORT_EVERY, Descent, TrainingStage
from isocharge.train.training.network import Perceptron


def task(scores, steps=20 * REPORT_EVERY, warm_up_steps=0):
    """A small network that is pulled to a target, and scores as given, one look after the other."""
    torch.manual_seed(0)
    part, given, seen = Perceptron(2, (4, 4), 1), iter(scores), []

    def loss(_, random):
        inputs = torch.rand(8, 2, generator=random)
        return ((part(inputs) - inputs.sum(dim=1, keepdim=True)) ** 2).mean()

    def score():
        seen.append({name: values.clone() for name, values in part.state_dict().items()})
        return next(given), "words"

    return TrainingStage("stage", part, loss, score, steps, warm_up_steps), seen


def run(made, patience=10**6):
    calls = []
    Descent(made, 1e-2, patience, seed=0).run(Checkpoint(), lambda *call: calls.append(call))
    return calls


def same(one, other):
    return all(torch.equal(one[name], other[name]) for name in one)


def test_the_best_network_is_kept():
    made, seen = task([3.0, 1.0, 2.0, 4.0], steps=4 * REPORT_EVERY)
    run(made)
    assert same(made.part.state_dict(), seen[1])
    assert not same(seen[1], seen[3])


def test_it_ends_when_nothing_better_has_come_for_long():
    made, seen = task([5.0, 2.0, *[3.0] * 18])
    calls = run(made, patience=3 * REPORT_EVERY)
    assert [step for step, _ in calls] == [REPORT_EVERY * k for k in (1, 2, 3, 4, 5)]
    assert same(made.part.state_dict(), seen[1])


def test_nothing_counts_while_another_loss_is_trained():
    made, seen = task([0.0, 0.0, 2.0, 3.0], steps=4 * REPORT_EVERY, warm_up_steps=2 * REPORT_EVERY)
    run(made, patience=REPORT_EVERY + 1)
    assert same(made.part.state_dict(), seen[2])


def test_it_learns():
    made, _ = task(range(5, 0, -1), steps=5 * REPORT_EVERY)
    run(made)
    inputs = torch.rand(50, 2)
    assert torch.allclose(made.part(inputs), inputs.sum(dim=1, keepdim=True), atol=0.02)


def test_a_score_that_is_no_number_is_an_error():
    made, _ = task([float("nan")] * 20)
    with pytest.raises(TrainingError, match=r"the stage loss is .* at step 200 of 4000; lower training.learning_rate"):
        run(made)


def test_words_and_loss_are_told():
    made, _ = task([1.0], steps=50)
    (call,) = run(made)
    assert call[0] == 50
    assert call[1].startswith("stage: loss ")
    assert call[1].endswith("words")
