/* The signal chain; see isocharge_chain.h. Each stage is explained in isocharge.serve.signal_chain. */
#include "isocharge_chain.h"

#include <math.h>
#include <string.h>

#define N ISOCHARGE_ELECTRODES
#define EACH(k) for (int k = 0; k < N; ++k)

typedef isocharge_real real;

#ifdef ISOCHARGE_CHAIN_FLOAT
#define EXP expf
#define EXPM1 expm1f
#define SQRT sqrtf
#define ABS fabsf
#else
#define EXP exp
#define EXPM1 expm1
#define SQRT sqrt
#define ABS fabs
#endif

static const real LARGEST = (real)ISOCHARGE_GAIN_LARGEST;

static real smaller(real a, real b) { return b < a ? b : a; }

static real larger(real a, real b) { return b > a ? b : a; }

#if ISOCHARGE_TARE_ON && !ISOCHARGE_LEAK_ON
#define TARE_FOLLOWS 1
#else
#define TARE_FOLLOWS 0
#endif

#if ISOCHARGE_HUM_ON || ISOCHARGE_LEAK_ON || TARE_FOLLOWS
static real within(real value, real limit) { return smaller(larger(value, -limit), limit); }
#endif

/* Forget everything that a tare decides. */
static void forget_tare(isocharge_chain *chain)
{
#if ISOCHARGE_TARE_ON
    chain->waiting = chain->next = chain->frames = 0;
#endif
    chain->tared = 0;
#if ISOCHARGE_LEAK_ON
    chain->leak_running = 0;
#endif
    chain->contact = chain->below = chain->saturated = chain->slow = 0;
#if ISOCHARGE_TOUCH_ON
    chain->peak = chain->rest_s = 0;
    EACH(k)
    {
        chain->last[k] = chain->base[k] = chain->mean[k] = 0;
        chain->direction[k] = ISOCHARGE_TOUCH_ANY_SIGN ? 0 : 1;
    }
#endif
#if ISOCHARGE_COMMON_MODE_ON
    chain->drift_pC = chain->drift_pC2 = chain->waited_s = 0;
    chain->blind = 0;
#endif
}

void isocharge_chain_start(isocharge_chain *chain)
{
    memset(chain, 0, sizeof *chain);
    EACH(k) chain->tare_pC[k] = chain->noise_pC[k] = 0;
    chain->invalid_s = 0;
#if ISOCHARGE_HUM_ON
    EACH(k) chain->hum_re[k] = chain->hum_im[k] = 0;
    chain->turn_re = 1;
    chain->turn_im = chain->hum_waited_s = 0;
#endif
    forget_tare(chain);
}

void isocharge_chain_tare(isocharge_chain *chain)
{
    forget_tare(chain);
#if ISOCHARGE_TARE_ON
    chain->patient = 1;
#endif
#if ISOCHARGE_HUM_ON
    chain->hum_running = 0;
    chain->hum_learned_s = 0;
#endif
}

#if ISOCHARGE_HUM_ON
/* Subtract the hum from charges, and learn it from their changes since a frame shortly before. */
static void remove_hum(isocharge_chain *chain, const real raw_pC[N], real quiet_pC[N], double t_s, real dt_s)
{
    const double cycles = ISOCHARGE_HUM_FREQUENCY_HZ * t_s;
    const double phase = 6.283185307179586 * (cycles - floor(cycles));
    const real re = (real)cos(phase), im = (real)sin(phase);
    const real step_re = re - chain->turn_re, step_im = im - chain->turn_im;
    const real norm = step_re * step_re + step_im * step_im;
    const int turned = norm > (real)ISOCHARGE_HUM_MIN_SQUARED_STEP;

    chain->hum_waited_s += dt_s;
    if (chain->hum_running && turned) {
        real average_s, share;
        chain->hum_learned_s += chain->hum_waited_s;
        average_s = larger(smaller((real)ISOCHARGE_HUM_SETTLE_S, chain->hum_learned_s), (real)ISOCHARGE_SUM_TOLERANCE_S);
        share = smaller(1, 2 * chain->hum_waited_s / average_s) / norm;
        EACH(k)
        {
            const real change = raw_pC[k] - chain->hum_raw_pC[k];
            const real known = chain->hum_re[k] * step_re - chain->hum_im[k] * step_im;
            const real error = within(change - known, (real)ISOCHARGE_HUM_LIMIT_PC);

            chain->hum_re[k] += error * share * step_re;
            chain->hum_im[k] -= error * share * step_im;
        }
    }
    if (!chain->hum_running || turned || 10 * (real)ISOCHARGE_HUM_FREQUENCY_HZ * chain->hum_waited_s > 1) {
        chain->turn_re = re;
        chain->turn_im = im;
        chain->hum_running = 1;
        chain->hum_waited_s = 0;
        EACH(k) chain->hum_raw_pC[k] = raw_pC[k];
    }
    EACH(k) quiet_pC[k] = raw_pC[k] - (chain->hum_re[k] * re - chain->hum_im[k] * im);
}
#endif

#if ISOCHARGE_TARE_ON
/* Mean and noise of the waiting frames, the oldest first; whether nothing moves. */
static int measure_tare(const isocharge_chain *chain, real mean_pC[N], real noise_pC[N])
{
    const long frames = ISOCHARGE_TARE_FRAMES;
    int quiet = 1;

    EACH(k)
    {
        real sum = 0, squares = 0;

        for (long n = 0; n < frames; ++n)
            sum += chain->waiting_pC[(chain->next + n) % frames][k];
        mean_pC[k] = sum / (real)frames;
        for (long n = 0; n < frames; ++n) {
            const real apart = chain->waiting_pC[(chain->next + n) % frames][k] - mean_pC[k];
            squares += apart * apart;
        }
        noise_pC[k] = SQRT(squares / (real)frames);
        quiet = quiet && noise_pC[k] <= (real)ISOCHARGE_TARE_NOISE_LIMIT_PC &&
                ABS(mean_pC[k]) <= (real)ISOCHARGE_TARE_OFFSET_LIMIT_PC;
    }
    return quiet;
}
#endif

/* Tare on the latest frames as soon as they are enough and quiet; 0 if they were not for longer than one waits. */
static int look_for_tare(isocharge_chain *chain, const real quiet_pC[N])
{
#if ISOCHARGE_TARE_ON
    real mean_pC[N], noise_pC[N];

    EACH(k) chain->waiting_pC[chain->next][k] = quiet_pC[k];
    chain->next = (chain->next + 1) % ISOCHARGE_TARE_FRAMES;
    if (chain->waiting < ISOCHARGE_TARE_FRAMES)
        ++chain->waiting;
    if (!chain->patient && chain->frames < ISOCHARGE_TARE_PATIENCE)
        ++chain->frames;
    if (chain->waiting < ISOCHARGE_TARE_FRAMES)
        return 1;
    if (!measure_tare(chain, mean_pC, noise_pC))
        return chain->patient || ISOCHARGE_TARE_PATIENCE == 0 || chain->frames < ISOCHARGE_TARE_PATIENCE;
    EACH(k)
    {
        chain->tare_pC[k] = mean_pC[k];
        chain->noise_pC[k] = noise_pC[k];
    }
    chain->waiting = chain->next = 0;
#else
    EACH(k) chain->tare_pC[k] = chain->noise_pC[k] = 0;
    (void)quiet_pC;
#endif
    chain->tared = 1;
    return 1;
}

#if ISOCHARGE_LEAK_ON
/* Begin the interval whose mean inflow is the next candidate. */
static void begin_interval(isocharge_chain *chain)
{
    chain->candidate_age_s = 0;
    chain->inflow_count = 1;
    EACH(k) chain->inflow_sum[k] = chain->inflow[k];
}

/* Correct the inflow by the clipped surplus; after a while the candidate becomes the trusted inflow. */
static void learn_inflow(isocharge_chain *chain, const real surplus_pC[N], real dt_s)
{
    const real learned_s = chain->learned_s + dt_s;
    const real averaging_s = larger(smaller((real)ISOCHARGE_LEAK_SETTLE_S, learned_s), dt_s);

    EACH(k)
    {
        const real sigmas = (real)ISOCHARGE_LEAK_CLIP_SIGMAS * (real)1.4142135623730951 * chain->noise_pC[k];
        const real limit_pC = larger((real)ISOCHARGE_LEAK_CLIP_PC, sigmas);

        chain->inflow[k] += within(surplus_pC[k], limit_pC) / averaging_s;
        chain->inflow_sum[k] += chain->inflow[k];
    }
    ++chain->inflow_count;
    chain->learned_s = learned_s;
    chain->candidate_age_s += dt_s;
    if (chain->candidate_age_s < (real)(ISOCHARGE_LEAK_LOOK_BACK_S - ISOCHARGE_SUM_TOLERANCE_S))
        return;
    EACH(k)
    {
        chain->trusted[k] = chain->candidate[k];
        chain->candidate[k] = chain->inflow_sum[k] / (real)chain->inflow_count;
    }
    begin_interval(chain);
}

/* Set the charges to 0 if the touch ended in a gap; otherwise state whether the gap may have falsified them. */
static void examine_gap(isocharge_chain *chain, real surplus_pC[N], const real tau_s[N])
{
    int left = chain->contact, falsified = chain->falsified;

    EACH(k)
    {
        const real charge_pC = chain->charge_pC[k], noise_pC = chain->noise_pC[k];
        const real sign = (real)((charge_pC > 0) - (charge_pC < 0));
        const real growth = EXP(smaller(chain->step_s / tau_s[k], 60));
        const real margin_pC = larger(4 * noise_pC, (real)0.05 * ABS(charge_pC));
        const real smallest_pC = charge_pC + surplus_pC[k] * (1 + growth) / 2;
        const real error_pC = ABS(surplus_pC[k]) * (growth - 1) / 2;

        left = left && sign * smallest_pC <= growth * margin_pC;
        falsified = falsified || error_pC > larger(noise_pC, (real)0.01 * ABS(charge_pC + surplus_pC[k]));
    }
    chain->falsified = falsified && !left;
    if (left)
        EACH(k) surplus_pC[k] = -chain->charge_pC[k];
}

/* Undo the amplifier's decay: charges after the next frame. */
static void undo_leak(isocharge_chain *chain, const real output_pC[N], real dt_s)
{
    static const real tau_s[N] = ISOCHARGE_LEAK_TAU_S;
    const real relax = chain->contact ? 1 : EXP(-dt_s / (real)ISOCHARGE_LEAK_RELAX_S); /* of an earlier charge */
    const int late = dt_s > (real)1.5 * chain->step_s; /* frames are missing or were invalid */
    real surplus_pC[N];

    EACH(k)
    {
        const real lost = -EXPM1(-dt_s / tau_s[k]); /* 1 minus the decay, which single precision would round */
        const real innovation_pC = (output_pC[k] - chain->output_pC[k] + lost * chain->output_pC[k]) * 2 / (2 - lost);

        surplus_pC[k] = innovation_pC - chain->inflow[k] * dt_s;
        chain->charge_pC[k] *= relax;
        chain->output_pC[k] = output_pC[k];
    }
    chain->step_s = dt_s;
    chain->falsified = chain->falsified && chain->contact;
    if (late) {
        real new_pC[N];

        EACH(k) new_pC[k] = surplus_pC[k];
        examine_gap(chain, new_pC, tau_s);
        EACH(k) chain->charge_pC[k] += new_pC[k];
    } else {
        EACH(k) chain->charge_pC[k] += surplus_pC[k];
    }
    if (chain->contact) {
        EACH(k) chain->inflow[k] = chain->candidate[k] = chain->trusted[k];
        begin_interval(chain);
        chain->hold_s = (real)ISOCHARGE_LEAK_HOLD_OFF_S;
        return;
    }
    if (chain->hold_s > (real)ISOCHARGE_SUM_TOLERANCE_S || !ISOCHARGE_LEAK_LEARN)
        chain->hold_s -= dt_s;
    else
        learn_inflow(chain, surplus_pC, dt_s);
}

/* The state at the tare, which is the mean output at rest. */
static void start_leak(isocharge_chain *chain, real dt_s)
{
    EACH(k)
    {
        chain->output_pC[k] = chain->charge_pC[k] = 0;
        chain->inflow[k] = chain->trusted[k] = chain->candidate[k] = 0;
    }
    begin_interval(chain);
    chain->hold_s = 0;
    chain->learned_s = 1;
    chain->step_s = dt_s;
    chain->falsified = 0;
    chain->leak_running = 1;
}
#endif

#if ISOCHARGE_TOUCH_ON
static real dot(const real a[N], const real b[N])
{
    real sum = 0;

    EACH(k) sum += a[k] * b[k];
    return sum;
}

static real size_of(const real vector[N])
{
    return SQRT(dot(vector, vector));
}

static void copy(real to[N], const real from[N])
{
    EACH(k) to[k] = from[k];
}
#endif

/* Contact with hysteresis, from the charges in units of their thresholds.

   follows  whether the tare follows the drift, so that a remainder of the latest touch does not decay */
static void update_contact(isocharge_chain *chain, const real charge_pC[N], real decay, int follows, real dt_s)
{
#if ISOCHARGE_TOUCH_ON
    const real root = SQRT((real)N), half_root = SQRT((real)0.5);
    const real sizes = root + (real)ISOCHARGE_TOUCH_SIGMAS * half_root;
    real charge[N], change[N], size, change_size, opposing, two_frame_peak, rising;
    int reversed, remainder;

    EACH(k) charge[k] = charge_pC[k] / larger(sizes * chain->noise_pC[k] + (real)ISOCHARGE_TOUCH_FLOOR_PC / root, (real)1e-12);
    size = size_of(charge);
    two_frame_peak = smaller(size, size_of(chain->last));
    EACH(k) change[k] = ISOCHARGE_TOUCH_ANY_SIGN ? chain->last[k] : 1;
    reversed = dot(charge, change) < 0;
    copy(chain->last, charge);
    chain->below = 0;
    if (chain->contact) {
        chain->peak = larger(chain->peak, two_frame_peak);
        if (size < larger((real)ISOCHARGE_TOUCH_RELEASE_SHARE * chain->peak, (real)0.5) || reversed) {
            chain->contact = chain->slow = 0;
            chain->rest_s = 0;
            copy(chain->base, charge);
            copy(chain->mean, charge);
        } else {
            EACH(k) chain->direction[k] += charge[k] / size;
        }
        return;
    }
    remainder = dot(chain->base, chain->direction) >= 0;
    EACH(k)
    {
        if (!(follows && remainder))
            chain->base[k] *= decay;
        change[k] = charge[k] - chain->base[k];
    }
    change_size = size_of(change);
    opposing = (real)-0.25 * size_of(chain->direction);
    if (dot(change, chain->direction) < opposing * change_size) {
        copy(chain->base, chain->mean); /* the opposite of a touch, such as the end of a long press */
    } else if (smaller(size, change_size) > 1 && dot(charge, chain->direction) >= opposing * size) {
        chain->contact = 1;
        chain->peak = two_frame_peak;
        EACH(k)
        {
            chain->direction[k] = charge[k] / size;
            change[k] = chain->mean[k] - chain->base[k];
        }
        chain->slow = larger(size_of(change), change_size - size) > (real)0.5;
        return;
    } else if (remainder && size < size_of(chain->base)) {
        copy(chain->base, charge);
        copy(chain->mean, charge);
    }
    rising = EXP(-dt_s / (real)ISOCHARGE_TOUCH_RISE_S);
    EACH(k) chain->mean[k] = charge[k] + rising * (chain->mean[k] - charge[k]);
    chain->below = size > 1 && dot(charge, chain->direction) < 0;
    chain->rest_s = size > 1 ? 0 : chain->rest_s + dt_s;
    if (chain->rest_s >= (real)(ISOCHARGE_TOUCH_RISE_S - ISOCHARGE_SUM_TOLERANCE_S))
        EACH(k) chain->direction[k] = ISOCHARGE_TOUCH_ANY_SIGN ? 0 : 1;
#else
    (void)charge_pC;
    (void)decay;
    (void)follows;
    (void)dt_s;
    chain->contact = 1;
#endif
}

#if ISOCHARGE_COMMON_MODE_ON
/* The common charge of a warming film, as far as this frame tells; returns its change. */
static real track_thermal_drift(isocharge_chain *chain, const real charge_pC[N], real dt_s)
{
    real slope = 0, curvature = 0, estimate_pC2 = 0, predicted_pC2, change_pC, gain;

    chain->waited_s += dt_s;
    if (chain->waited_s < (real)(ISOCHARGE_COMMON_MODE_EVERY_S - ISOCHARGE_SUM_TOLERANCE_S))
        return 0;
    predicted_pC2 = chain->drift_pC2 + (real)(ISOCHARGE_COMMON_MODE_WANDER_PC * ISOCHARGE_COMMON_MODE_WANDER_PC) * chain->waited_s;
    chain->waited_s = 0;
    for (int n = -2; n <= 2; ++n) { /* the parabola of the squared misfit by least squares */
        float tried_pC[N], contact[7];
        real square;

        EACH(k) tried_pC[k] = (float)(charge_pC[k] - (real)(10 * n));
        isocharge_predict(tried_pC, contact);
        square = (real)contact[6] * (real)contact[6];
        slope += (real)(10 * n) / 1000 * square;
        curvature += (real)(100 * n * n - 200) / 140000 * square;
    }
    chain->blind = !(curvature > 0);
    if (!chain->blind) {
        estimate_pC2 = (real)(ISOCHARGE_COMMON_MODE_NOISE * ISOCHARGE_COMMON_MODE_NOISE) / curvature;
        chain->blind = estimate_pC2 > (real)(ISOCHARGE_COMMON_MODE_BLIND_PC * ISOCHARGE_COMMON_MODE_BLIND_PC);
    }
    if (chain->blind) {
        chain->drift_pC2 = predicted_pC2;
        return 0;
    }
    change_pC = smaller(larger(-slope / (2 * curvature), -20), 20);
    gain = predicted_pC2 / (predicted_pC2 + estimate_pC2);
    chain->drift_pC2 = (1 - gain) * predicted_pC2;
    chain->drift_pC += gain * change_pC;
    return gain * change_pC;
}
#endif

/* The stages behind the tare. */
static void advance_tared(isocharge_chain *chain, const real quiet_pC[N], real dt_s, int limited,
                          isocharge_reading *reading)
{
    real output_pC[N], *charge_pC = reading->charge_pC, decay = 1;

#if TARE_FOLLOWS
    const real kept = EXP(-dt_s / (real)ISOCHARGE_TARE_RELAX_S);
    decay = kept;
#endif
    EACH(k)
    {
        reading->tare_pC[k] = chain->tare_pC[k];
        output_pC[k] = quiet_pC[k] - chain->tare_pC[k];
    }
#if ISOCHARGE_LEAK_ON
    if (!chain->leak_running)
        start_leak(chain, dt_s);
    undo_leak(chain, output_pC, dt_s);
    decay = EXP(-dt_s / (real)ISOCHARGE_LEAK_RELAX_S);
    EACH(k) charge_pC[k] = chain->charge_pC[k];
    reading->flags |= chain->falsified ? ISOCHARGE_GAP : 0u;
#else
    EACH(k) charge_pC[k] = output_pC[k];
#endif
    update_contact(chain, charge_pC, decay, TARE_FOLLOWS, dt_s);
    chain->saturated = limited || (chain->saturated && chain->contact);
#if ISOCHARGE_COMMON_MODE_ON
    if (!chain->contact) {
        chain->drift_pC = chain->drift_pC2 = chain->waited_s = 0;
        chain->blind = 0;
    } else if (!chain->saturated) {
        const real change_pC = track_thermal_drift(chain, charge_pC, dt_s);
        EACH(k)
        {
            charge_pC[k] -= change_pC;
#if ISOCHARGE_LEAK_ON
            chain->charge_pC[k] -= change_pC;
#else
            chain->tare_pC[k] += change_pC;
            reading->tare_pC[k] = chain->tare_pC[k];
#endif
        }
    }
    if (chain->contact && !chain->saturated && ABS(chain->drift_pC) >= (real)ISOCHARGE_COMMON_MODE_TELL_PC)
        reading->flags |= ISOCHARGE_THERMAL;
    if (!chain->saturated && chain->blind)
        reading->flags |= ISOCHARGE_BLIND;
#else
    (void)dt_s;
#endif
#if TARE_FOLLOWS
    if (!chain->contact) {
        EACH(k)
        {
            const real apart = quiet_pC[k] - chain->tare_pC[k];
            chain->tare_pC[k] += (1 - kept) * within(apart, (real)ISOCHARGE_TARE_NOISE_LIMIT_PC);
        }
    }
#endif
    reading->contact = chain->contact;
    reading->flags |= (chain->saturated ? ISOCHARGE_SATURATED : 0u) | (chain->below ? ISOCHARGE_NEGATIVE : 0u) |
                      (chain->slow ? ISOCHARGE_DRIFT : 0u);
}

void isocharge_chain_advance(isocharge_chain *chain, const isocharge_real value[ISOCHARGE_ELECTRODES], double t_s,
                             isocharge_real dt_s, int limited, isocharge_reading *reading)
{
    static const real zero[N] = ISOCHARGE_GAIN_ZERO, gain_pC[N] = ISOCHARGE_GAIN_PC;
    real *raw_pC = reading->raw_pC, quiet_pC[N], squares = 0;

    EACH(k)
    {
        squares += value[k] / LARGEST * (value[k] / LARGEST);
        raw_pC[k] = (value[k] - zero[k]) * gain_pC[k];
        reading->charge_pC[k] = reading->tare_pC[k] = 0;
    }
    reading->contact = 0;
    reading->flags = 0;
    if (!(squares <= 1)) {
        chain->invalid_s += dt_s;
        reading->flags = ISOCHARGE_INVALID;
        return;
    }
    dt_s += chain->invalid_s;
    chain->invalid_s = 0;
#if ISOCHARGE_SATURATION_ON
    EACH(k) limited = limited || ABS(raw_pC[k]) >= (real)ISOCHARGE_SATURATION_LIMIT_PC;
#endif
#if ISOCHARGE_HUM_ON
    remove_hum(chain, raw_pC, quiet_pC, t_s, dt_s);
#else
    (void)t_s;
    EACH(k) quiet_pC[k] = raw_pC[k];
#endif
    if (chain->tared) {
        advance_tared(chain, quiet_pC, dt_s, limited, reading);
        return;
    }
    reading->flags = ISOCHARGE_TARE | (limited ? ISOCHARGE_SATURATED : 0u);
    if (!look_for_tare(chain, quiet_pC))
        reading->flags |= ISOCHARGE_TARE_FAILED;
}
