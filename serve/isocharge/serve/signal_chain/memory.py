"""The memory of the film undone together with the amplifier's leak: creep, the thermoelastic step, and warmth.

The film answers a step of the touch charge q with that step times

    h(t) = 1 - creep log10(t / 1 s) + thermoelastic exp(-t / warmth_s):

it creeps with the logarithm of time, so that a charge is what it is after a second; and what is stretched cools, whose
pyroelectric charge is gone when the film has its temperature again. The logarithm is a sum of exponentials with one
time constant in each decade (a Prony series; its ripple is 2 % of `creep`), so the film's charge

    y[n] = h(0) q[n] - sum_j w_j r_j[n] + d[n],     r_j[n] = e r_j[n-1] + (1 - e) q[n-1],     e = exp(-dt / tau_j)

is solved for q frame by frame, y being the amplifier's output with its leak undone (`signal_chain.leak`), r_j the touch
charge smoothed over tau_j. d is the pyroelectric charge of each electrode. The film follows the air within warmth_s, so
d's slope decays with that time. All of this is one product of a matrix with the rows r_j, d, its slope and q. Out of
contact q is 0 and d is what is seen: a fading memory filter (g = 1 - f^2, h = (1 - f)^2; Brookner 1998, chapter 1)
follows both. In a touch they are predicted, from `look_back_s` before it.

What is left on the film after a release says how well creep and step are known: a Kalman filter of their two scales
takes it in, as far as it is more than warmth may have done since the touch began.
"""

import math
from functools import lru_cache
from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta

from isocharge.common.arrays import Array
from isocharge.serve.signal_chain.leak import Leak, LeakRule, learn_inflow
from isocharge.serve.signal_chain.rule import Rule, Share, TimeConstant

DECADES_S = 10.0 ** np.arange(-3, 5)
"""Time constants of creep, s: good from 1 ms to some minutes."""

WARM, SLOPE, HELD = -3, -2, -1
"""Rows of the warmth, of its slope and of the touch charge, after those of the terms: creep's, and the step's last."""

WARMTH = slice(WARM, HELD)
"""The warmth and its slope."""

NOW = np.diag([*np.ones(len(DECADES_S) + 3), 0.0])
"""What rows are without any time for change, shape (rows, rows); the touch charge is not known yet."""

OF_SCALES = np.array(
    [
        [*-np.ones(len(DECADES_S)), 0.0, 0.0, 0.0, -np.expm1(-1.0 / DECADES_S).sum()],
        [*np.zeros(len(DECADES_S)), -1.0, 0.0, 0.0, 1.0],
    ]
)
"""What is seen more of each row with a creep of 1, and with a step of 1, shape (2, rows), dimensionless."""

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


class MemoryRule(Rule, frozen=True, kw_only=True):
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


@lru_cache(maxsize=8)
def _relaxed(warmth_s: float) -> tuple[Array, Array]:
    """Time constants of the rows, shape (rows, 1), s, and what the rows are in the end, shape (rows, rows)."""
    limit = np.zeros_like(NOW)
    limit[:WARM, HELD], limit[WARM, WARM:HELD] = 1.0, (1.0, warmth_s)
    return np.array([*DECADES_S, *[warmth_s] * 4])[:, np.newaxis], limit


@lru_cache(maxsize=256)
def _passage(warmth_s: float, dt_s: float) -> Array:
    """What the rows become in a time dt_s, as a product with this, shape (rows, rows)."""
    times_s, limit = _relaxed(warmth_s)
    return np.asarray(limit + np.exp(-dt_s / times_s) * (NOW - limit))


class Film(NamedTuple):
    """What is known of a film.

    Attributes:
        creep, thermoelastic: As in `MemoryRule`, by what was learned since.
        seen: What is seen of each row, shape (rows,), dimensionless.
        at_once: What is seen at once of a step of 1: h(0).
        variances: Of the scales of creep and step, and their covariance, dimensionless.
    """

    creep: float
    thermoelastic: float
    seen: Array
    at_once: float
    variances: tuple[float, float, float]

    @classmethod
    def of(cls, creep: float, thermoelastic: float, variances: tuple[float, float, float]) -> "Film":
        """From its two numbers."""
        seen = creep * OF_SCALES[0] + thermoelastic * OF_SCALES[1]
        seen[WARM] = 1.0
        seen[HELD] += 1.0
        return cls(creep, thermoelastic, seen, float(seen[HELD]), variances)


class Memory(NamedTuple):
    """What the stage remembers.

    Attributes:
        film: What is known of the film.
        leak: Touch charge, amplifier's output and inflow.
        film_pC: The film's charge y, shape (electrodes,), pC.
        rows_pC: The state, shape (rows, electrodes): r, pC, d, pC, and its slope, pC/s, and q, pC, 0 out of contact.
        trusted_pC: d and its slope at least `look_back_s` ago, before a touch could affect it, shape (2, electrodes).
        candidate_pC: What becomes trusted when it is that old.
        expected_pC: What d and its slope were expected to be before they were seen again, after a release.
        trusted_s, candidate_s: How old the first two are, s.
        unseen_s: Time in which d was not seen, s.
        learn_s: Time for which the film is still learned, s; a finger still leaves while it is above LEARN_S.
    """

    film: Film
    leak: Leak
    film_pC: Array
    rows_pC: Array
    trusted_pC: Array
    candidate_pC: Array
    expected_pC: Array
    trusted_s: float = 0.0
    candidate_s: float = 0.0
    unseen_s: float = 0.0
    learn_s: float = 0.0

    @property
    def lingers(self) -> bool:
        """Whether something touches, or has just been released."""
        return self.learn_s > LEARN_S

    @classmethod
    def start(cls, rule: MemoryRule, output_pC: Array) -> "Memory":
        """At the first frame after the tare."""
        rows_pC = np.zeros((len(NOW), output_pC.size))
        film = Film.of(rule.creep, rule.thermoelastic, (rule.known**2, rule.known**2, 0.0))
        leak = Leak.start(output_pC)._replace(charge_pC=output_pC / film.at_once)
        cold_pC = rows_pC[WARMTH]
        return cls(film, leak, output_pC, rows_pC, cold_pC, cold_pC, cold_pC)


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
    passage = _passage(rule.warmth_s, dt_s)
    rows_pC = passage.dot(memory.rows_pC)
    apart_pC = film_pC - film.seen.dot(rows_pC)
    charge_pC = apart_pC / film.at_once
    unseen_s = memory.unseen_s + dt_s
    if contact or memory.lingers:
        trusted = leak.trusted_pC_per_s
        leak = Leak(charge_pC, output_pC, trusted, trusted, trusted, 0.0, leak.learned_s, leak_rule.hold_off_s)
        rows_pC[HELD], warmth_pC = charge_pC, rows_pC[WARMTH]
        learn_s = LEARN_S + LINGER_S if contact else memory.learn_s - dt_s
        return Memory(film, leak, film_pC, rows_pC, warmth_pC, warmth_pC, warmth_pC, 0.0, 0.0, unseen_s, learn_s)
    fading = math.exp(-dt_s / rule.settle_s)
    rows_pC[WARM] += (1.0 - fading * fading) * apart_pC
    leak = Leak(charge_pC, output_pC, *leak[2:])
    if leak.hold_s > 0.0:
        leak = leak._replace(hold_s=leak.hold_s - dt_s)
    else:
        rows_pC[SLOPE] += ((1.0 - fading) ** 2 / max(dt_s, 1e-9)) * apart_pC
        calm = leak.learned_s < leak_rule.settle_s or max(map(abs, rows_pC[SLOPE].tolist())) < CALM_PC_PER_S
        if tau_s is not None and leak_rule.learn and calm:
            change_pC = rows_pC - memory.rows_pC
            recovery_pC = film.seen.dot(change_pC) - change_pC[WARM]
            leak = learn_inflow(leak_rule, leak, surplus_pC - recovery_pC, noise_pC, dt_s)
    learn_s, expected_pC = memory.learn_s, memory.expected_pC
    learns = learn_s > 0.0
    if learns:
        learn_s, expected_pC = learn_s - dt_s, passage[WARMTH, WARMTH].dot(expected_pC)
    warmths_pC, ages_s = (memory.trusted_pC, memory.candidate_pC), (memory.trusted_s + dt_s, memory.candidate_s + dt_s)
    after = Memory(film, leak, film_pC, rows_pC, *warmths_pC, expected_pC, *ages_s, unseen_s, learn_s)
    if learns and leak.hold_s <= 0.0:
        after = _learn_film(after, dt_s)
    if after.candidate_s >= leak_rule.look_back_s:
        after = after._replace(
            trusted_pC=after.candidate_pC,
            trusted_s=after.candidate_s,
            candidate_pC=after.rows_pC[WARMTH],
            candidate_s=0.0,
        )
    return after


def _learn_film(memory: Memory, dt_s: float) -> Memory:
    """Both scales by what is left on the film along the touch's charges; all frames after a release count as one."""
    film, rows_pC = memory.film, memory.rows_pC.copy()
    by_scales = OF_SCALES.dot(rows_pC)
    crept_pC, cooled_pC = film.creep * by_scales[0], film.thermoelastic * by_scales[1]
    along = crept_pC + cooled_pC
    size = math.sqrt(float(along @ along))
    if size < 1e-9:
        return memory
    by_creep, by_step = float(crept_pC @ along) / size, float(cooled_pC @ along) / size
    left_pC = float((rows_pC[WARM] - memory.expected_pC[0]) @ along) / size
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
    rows_pC[WARM] -= (creep - 1.0) * crept_pC + (step - 1.0) * cooled_pC
    return memory._replace(film=Film.of(film.creep * creep, film.thermoelastic * step, variances), rows_pC=rows_pC)


def begin_touch(rule: MemoryRule, memory: Memory) -> Memory:
    """The state at the first frame of a touch: warmth as predicted from before it."""
    film, rows_pC, age_s = memory.film, memory.rows_pC.copy(), memory.trusted_s
    rows_pC[WARMTH] = _passage(rule.warmth_s, age_s)[WARMTH, WARMTH].dot(memory.trusted_pC)
    rows_pC[HELD] = 0.0
    charge_pC = rows_pC[HELD] = (memory.film_pC - film.seen.dot(rows_pC)) / film.at_once
    return memory._replace(
        leak=memory.leak._replace(charge_pC=charge_pC),
        rows_pC=rows_pC,
        unseen_s=max(memory.unseen_s, age_s) if memory.lingers else age_s,
        learn_s=LEARN_S + LINGER_S,
    )


def warmer(memory: Memory, change_pC: Array | float, rate_pC_per_s: Array | float, *, learns: bool = True) -> Memory:
    """The state if so much more of the touch charge, shape (electrodes,), pC, and of its slope, pC/s, is warmth.

    With `learns` false, nothing is learned of the film after this touch: its warmth is not known well enough.
    """
    at_once, charge_pC, rows_pC = memory.film.at_once, memory.leak.charge_pC - change_pC, memory.rows_pC.copy()
    rows_pC[WARM] += at_once * change_pC
    rows_pC[SLOPE] += at_once * rate_pC_per_s
    rows_pC[HELD] = charge_pC
    return memory._replace(
        leak=memory.leak._replace(charge_pC=charge_pC),
        rows_pC=rows_pC,
        unseen_s=memory.unseen_s if learns else math.inf,
    )


def doubt(memory: Memory) -> float:
    """Relative standard deviation of all touch charges together, because creep and step are not known better."""
    rows_pC = memory.rows_pC.sum(axis=1)
    total_pC = float(rows_pC[HELD])
    if total_pC <= 0.0:
        return 0.0
    crept, cooled = OF_SCALES.dot(rows_pC).tolist()
    crept, cooled = memory.film.creep * crept / total_pC, memory.film.thermoelastic * cooled / total_pC
    of_creep, of_step, both = memory.film.variances
    return math.sqrt(max(crept * crept * of_creep + cooled * cooled * of_step + 2.0 * crept * cooled * both, 0.0))
