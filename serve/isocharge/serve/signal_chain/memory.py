"""The memory of the film undone together with the amplifier's leak: creep, the thermoelastic step, and warmth.

The film answers a step of the touch charge q with that step times

    h(t) = 1 - creep log10(t / 1 s) + thermoelastic exp(-t / warmth_s):

it creeps with the logarithm of time, so that a charge is what it is after a second; and what is stretched cools, whose
pyroelectric charge is gone when the film has its temperature again. The logarithm is a sum of exponentials with one
time constant in each decade (a Prony series; its ripple is 2 % of `creep`), so the film's charge

    y[n] = h(inf) q[n] + sum_j x_j[n] + d[n],     x_j[n] = exp(-dt / tau_j) x_j[n-1] + w_j (q[n] - q[n-1])

is solved for q frame by frame, y being the amplifier's output with its leak undone (`signal_chain.leak`). d is the
pyroelectric charge of each electrode. The film follows the air within warmth_s, so d's slope decays with that time. Out
of contact q is 0 and d is what is seen: a fading memory filter (g = 1 - f^2, h = (1 - f)^2; Brookner 1998, chapter 1)
follows both. In a touch they are predicted, from `look_back_s` before it.

What is left on the film after a release says how well creep and step are known: a Kalman filter of their two scales
takes it in, as far as it is more than warmth may have done since the touch began.
"""

import math
from functools import cached_property
from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta

from isocharge.common.arrays import Array
from isocharge.serve.signal_chain.leak import Leak, LeakRule, learn_inflow
from isocharge.serve.signal_chain.rule import Rule, Share, TimeConstant

DECADES_S = 10.0 ** np.arange(-3, 5)
"""Time constants of creep, s: good from 1 ms to some minutes."""

LEARN_S = 5.0
"""Time after a release in which the film's scales are learned, s."""

MOST_CREEP = 0.2
"""Share in a decade from which nothing would be left of a charge after some days."""

LINGER_S = 0.1
"""Time after a release in which a finger still leaves the film, s: its last charges are not warmth yet."""

WANDER_PC, UNLIKE = 1.0, 0.05
"""Noise of that: wandering warmth of an electrode in a second, pC; share of what creeps that is no such law."""

OUTLIER = 4.0
"""Deviations from which what is left after a release is something else: a hand that warms the film."""

CALM_PC_PER_S = 2.0
"""Slope of the warmth above which the amplifiers' inflow is not learned, pC/s: it would last, and warmth does not."""


class MemoryRule(Rule, frozen=True, kw_only=True, dict=True):
    """What a held press does to the film's charges; the section `[memory]` of a device file.

    Attributes:
        creep: Share of a charge that is lost in each decade of time.
        thermoelastic: Share that a touch has more at first, until the film has its temperature again.
        warmth_s: Time in which the film follows the temperature of the air, s.
        known: Relative standard deviation of `creep` and `thermoelastic`, for the deviations of contacts.
        settle_s: Time in which warmth is followed out of contact, s.
    """

    creep: Annotated[float, Meta(ge=0.0, lt=MOST_CREEP)] = 0.0
    thermoelastic: Share = 0.0
    warmth_s: TimeConstant = 2.5
    known: Share = 0.2
    settle_s: TimeConstant = 0.1

    @cached_property
    def times_s(self) -> Array:
        """Time constants of all terms, shape (terms,), s; the last one is that of the thermoelastic step."""
        return np.append(DECADES_S, self.warmth_s)


class Film(NamedTuple):
    """What is known of a film.

    Attributes:
        creep, thermoelastic: As in `MemoryRule`, by what was learned since.
        weights: w of all terms, shape (terms, 1).
        crept: Share that all of the creep takes after the first second: 1 - h(inf).
        at_once: What is seen at once of a step of 1: h(0).
        variances: Of the scales of creep and step, and their covariance, dimensionless.
    """

    creep: float
    thermoelastic: float
    weights: Array
    crept: float
    at_once: float
    variances: tuple[float, float, float]

    @classmethod
    def of(cls, creep: float, thermoelastic: float, variances: tuple[float, float, float]) -> "Film":
        """From its two numbers."""
        weights = np.append(np.full(len(DECADES_S), creep), thermoelastic)
        crept = creep * float(np.exp(-1.0 / DECADES_S).sum())
        at_once = 1.0 - crept + float(weights.sum())
        return cls(creep, thermoelastic, weights[:, np.newaxis], crept, at_once, variances)

    @property
    def extra(self) -> float:
        """Sum of the weights: h(0) - h(inf)."""
        return self.at_once - 1.0 + self.crept


class Warmth(NamedTuple):
    """Pyroelectric charges, shape (electrodes,), pC, their slopes, pC/s, and how long ago that was, s."""

    charge_pC: Array
    slope_pC_per_s: Array
    age_s: float = 0.0

    def after(self, dt_s: float, warmth_s: float) -> "Warmth":
        """What they become if the air stays as it is."""
        left = math.exp(-dt_s / warmth_s)
        charge_pC = self.charge_pC + self.slope_pC_per_s * (warmth_s * (1.0 - left))
        return Warmth(charge_pC, self.slope_pC_per_s * left, self.age_s)


class Memory(NamedTuple):
    """What the stage remembers.

    Attributes:
        film: What is known of the film.
        leak: Touch charge, amplifier's output and inflow.
        film_pC: The film's charge y, shape (electrodes,), pC.
        terms_pC: x, shape (terms, electrodes), pC.
        held_pC: The touch charge that x was told, shape (electrodes,), pC; 0 out of contact.
        warmth: d and its slope.
        trusted: The same at least `look_back_s` ago, before a touch could affect it.
        candidate: What becomes trusted when it is that old.
        expected: What d was expected to be before it was seen again, after a release.
        unseen_s: Time in which d was not seen, s.
        learn_s: Time for which the film is still learned, s; a finger still leaves while it is above LEARN_S.
    """

    film: Film
    leak: Leak
    film_pC: Array
    terms_pC: Array
    held_pC: Array
    warmth: Warmth
    trusted: Warmth
    candidate: Warmth
    expected: Warmth
    unseen_s: float = 0.0
    learn_s: float = 0.0

    @property
    def lingers(self) -> bool:
        """Whether something touches, or has just been released."""
        return self.learn_s > LEARN_S

    @classmethod
    def start(cls, rule: MemoryRule, output_pC: Array) -> "Memory":
        """At the first frame after the tare."""
        nothing = np.zeros_like(output_pC)
        cold = Warmth(nothing, nothing)
        terms = np.zeros((len(DECADES_S) + 1, output_pC.size))
        film = Film.of(rule.creep, rule.thermoelastic, (rule.known**2, rule.known**2, 0.0))
        leak = Leak.start(output_pC)._replace(charge_pC=output_pC / film.at_once)
        return cls(film, leak, output_pC, terms, nothing, cold, cold, cold, cold)


def undo_memory(
    rule: MemoryRule,
    leak_rule: LeakRule,
    tau_s: Array | None,
    memory: Memory,
    output_pC: Array,
    noise_pC: Array,
    dt_s: float,
    *,
    contact: bool,
) -> Memory:
    """The state after the next frame; the touch charge is `leak.charge_pC`.

    Args:
        rule: What the film does.
        leak_rule: How the inflow is learned, how old what a touch begins with, and how long to pause after a release.
        tau_s: Time constant of each amplifier, shape (electrodes,), s; None where charges do not leak.
        memory: After the frame before.
        output_pC: The amplifier's output above tare, shape (electrodes,), pC.
        noise_pC: Standard deviation of each electrode at rest, shape (electrodes,), pC.
        dt_s: Since the frame before, s.
        contact: Whether something touched in the frame before.
    """
    film, leak, film_pC = memory.film, memory.leak, output_pC
    surplus_pC = output_pC - leak.output_pC
    if tau_s is not None:
        surplus_pC = output_pC - np.exp(-dt_s / tau_s) * leak.output_pC - leak.inflow_pC_per_s * dt_s
        film_pC = memory.film_pC + surplus_pC
    left = np.exp(-dt_s / rule.times_s)
    terms_pC, remembered_pC = memory.terms_pC * left[:, np.newaxis], left.dot(memory.terms_pC)
    warmth = memory.warmth.after(dt_s, rule.warmth_s)
    apart_pC = film_pC - warmth.charge_pC - remembered_pC + film.extra * memory.held_pC
    charge_pC = apart_pC / film.at_once
    unseen_s = memory.unseen_s + dt_s
    if contact or memory.lingers:
        trusted = leak.trusted_pC_per_s
        leak = Leak(charge_pC, output_pC, trusted, trusted, trusted, 0.0, leak.learned_s, leak_rule.hold_off_s)
        terms_pC += film.weights * (charge_pC - memory.held_pC)
        warmths = (warmth, warmth, warmth, warmth)
        learn_s = LEARN_S + LINGER_S if contact else memory.learn_s - dt_s
        return Memory(film, leak, film_pC, terms_pC, charge_pC, *warmths, unseen_s, learn_s)
    terms_pC -= film.weights * memory.held_pC
    fading = math.exp(-dt_s / rule.settle_s)
    warm_pC, slope = warmth.charge_pC + (1.0 - fading * fading) * apart_pC, warmth.slope_pC_per_s
    if leak.hold_s > 0.0:
        leak = leak._replace(hold_s=leak.hold_s - dt_s)
    else:
        slope = slope + ((1.0 - fading) ** 2 / max(dt_s, 1e-9)) * apart_pC
        calm = leak.learned_s < leak_rule.settle_s or max(map(abs, slope.tolist())) < CALM_PC_PER_S
        if tau_s is not None and leak_rule.learn and calm:
            recovery_pC = (terms_pC - memory.terms_pC).sum(axis=0)
            leak = learn_inflow(leak_rule, leak, surplus_pC - recovery_pC, noise_pC, dt_s)
    leak = leak._replace(charge_pC=charge_pC, output_pC=output_pC)
    learn_s, expected = memory.learn_s, memory.expected
    learns = learn_s > 0.0
    if learns:
        learn_s, expected = learn_s - dt_s, expected.after(dt_s, rule.warmth_s)
    warmths = (Warmth(warm_pC, slope), memory.trusted, memory.candidate, expected)
    after = Memory(film, leak, film_pC, terms_pC, np.zeros_like(charge_pC), *warmths, unseen_s, learn_s)
    if learns and leak.hold_s <= 0.0:
        after = _learn_film(after, dt_s)
    return _grown_older(after, dt_s, leak_rule.look_back_s)


def _learn_film(memory: Memory, dt_s: float) -> Memory:
    """Both scales by what is left on the film along the touch's charges; all frames after a release count as one."""
    film, crept_pC, cooled_pC = memory.film, memory.terms_pC[:-1].sum(axis=0), memory.terms_pC[-1]
    along = crept_pC + cooled_pC
    size = math.sqrt(float(along @ along))
    if size < 1e-9:
        return memory
    by_creep, by_step = float(crept_pC @ along) / size, float(cooled_pC @ along) / size
    left_pC = float((memory.warmth.charge_pC - memory.expected.charge_pC) @ along) / size
    of_creep, of_step, both = film.variances
    to_creep, to_step = of_creep * by_creep + both * by_step, both * by_creep + of_step * by_step
    known_pC2 = by_creep * to_creep + by_step * to_step
    noise_pC2 = WANDER_PC**2 * len(along) * memory.unseen_s + (UNLIKE * size) ** 2
    if left_pC * left_pC > OUTLIER**2 * (known_pC2 + noise_pC2):
        return memory._replace(learn_s=0.0)
    total_pC2 = known_pC2 + noise_pC2 * LEARN_S / max(dt_s, 1e-9)
    creep, step = 1.0 + to_creep / total_pC2 * left_pC, 1.0 + to_step / total_pC2 * left_pC
    variances = (
        of_creep - to_creep**2 / total_pC2,
        of_step - to_step**2 / total_pC2,
        both - to_creep * to_step / total_pC2,
    )
    crept_pC, cooled_pC = crept_pC * (creep - 1.0), cooled_pC * (step - 1.0)
    terms_pC = memory.terms_pC * creep
    terms_pC[-1] = memory.terms_pC[-1] * step
    return memory._replace(
        film=Film.of(film.creep * creep, film.thermoelastic * step, variances),
        terms_pC=terms_pC,
        warmth=memory.warmth._replace(charge_pC=memory.warmth.charge_pC - crept_pC - cooled_pC),
    )


def _grown_older(memory: Memory, dt_s: float, look_back_s: float) -> Memory:
    """A frame later; every `look_back_s` the candidate becomes the trusted warmth."""
    (charge_pC, slope, age_s), before = memory.trusted, memory.candidate
    trusted = Warmth(charge_pC, slope, age_s + dt_s)
    candidate = Warmth(before.charge_pC, before.slope_pC_per_s, before.age_s + dt_s)
    if candidate.age_s >= look_back_s:
        trusted, candidate = candidate, memory.warmth
    return memory._replace(trusted=trusted, candidate=candidate)


def begin_touch(rule: MemoryRule, memory: Memory) -> Memory:
    """The state at the first frame of a touch: warmth as predicted from before it."""
    film, age_s = memory.film, memory.trusted.age_s
    warmth = memory.trusted.after(age_s, rule.warmth_s)._replace(age_s=0.0)
    apart_pC = memory.film_pC - warmth.charge_pC - memory.terms_pC.sum(axis=0)
    charge_pC = (apart_pC + film.extra * memory.held_pC) / film.at_once
    return memory._replace(
        leak=memory.leak._replace(charge_pC=charge_pC),
        terms_pC=memory.terms_pC + film.weights * (charge_pC - memory.held_pC),
        held_pC=charge_pC,
        warmth=warmth,
        unseen_s=max(memory.unseen_s, age_s) if memory.lingers else age_s,
        learn_s=LEARN_S + LINGER_S,
    )


def warmer(memory: Memory, change_pC: Array | float, rate_pC_per_s: Array | float, *, learns: bool = True) -> Memory:
    """The state if so much more of the touch charge, shape (electrodes,), pC, and of its slope, pC/s, is warmth.

    With `learns` false, nothing is learned of the film after this touch: its warmth is not known well enough.
    """
    film, charge_pC, warmth = memory.film, memory.leak.charge_pC - change_pC, memory.warmth
    return memory._replace(
        leak=memory.leak._replace(charge_pC=charge_pC),
        terms_pC=memory.terms_pC - film.weights * change_pC,
        held_pC=charge_pC,
        warmth=Warmth(
            warmth.charge_pC + film.at_once * change_pC, warmth.slope_pC_per_s + film.at_once * rate_pC_per_s
        ),
        unseen_s=memory.unseen_s if learns else math.inf,
    )


def doubt(memory: Memory) -> float:
    """Relative standard deviation of all touch charges together, because creep and step are not known better."""
    total_pC = sum(memory.held_pC.tolist())
    if total_pC <= 0.0:
        return 0.0
    *crept_pC, cooled_pC = memory.terms_pC.sum(axis=1).tolist()
    crept, cooled = sum(crept_pC) / total_pC - memory.film.crept, cooled_pC / total_pC
    of_creep, of_step, both = memory.film.variances
    return math.sqrt(max(crept * crept * of_creep + cooled * cooled * of_step + 2.0 * crept * cooled * both, 0.0))
