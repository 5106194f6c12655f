/* The network of $label in single precision. Written by isocharge train export-c. */
#include "isocharge_model.h"

#include <math.h>

/* tanh within 4e-7 for every x, as x P(x^2) / Q(x^2); beyond +-9.02 it is +-1 in single precision. NaN gives NaN.
   Without branches, so that a compiler can work on several numbers at once. All terms have one sign: nothing cancels. */
static float tanh_of(float x)
{
    const float bound = 9.02f;
    float square, p, q;

    x = x > bound ? bound : x;
    x = x < -bound ? -bound : x;
    square = x * x;
    p = 1.331876784e-8f;
    p = p * square + 2.058327738e-5f;
    p = p * square + 3.494022072e-3f;
    p = p * square + 1.337970746e-1f;
    p = p * square + 1.0f;
    q = 7.761905190e-7f;
    q = q * square + 3.283072452e-4f;
    q = q * square + 2.587102576e-2f;
    q = q * square + 4.671302270e-1f;
    q = q * square + 1.0f;
    return x * p / q;
}

/* A number within two bounds; NaN stays NaN. */
static float clip(float x, float low, float high)
{
    x = x < low ? low : x;
    return x > high ? high : x;
}

$features
$contact
$misfit
/* What the last layer gives, still without the functions of `contact_of`. */
static void answers_of(const float charge_pC[ISOCHARGE_ELECTRODES], float answers[$answers])
{
    float logs[$electrodes];

    features(charge_pC, logs);
    contact_answers(logs, answers);
    misfit_answers(logs, answers + $known);
}

static void contact_of(const float answers[$answers], float contact[7])
{
    float length = 0.0f;

    for (int i = 0; i < $plane; ++i)
        contact[i] = answers[i];
    for (int i = $plane; i < $logs; ++i)
        contact[i] = expf(clip(answers[i], -$largest_logarithm, $largest_logarithm));
    for (int i = $known; i < $answers; ++i)
        length += answers[i] * answers[i];
    contact[$logs] = sinhf(sqrtf(length)) * $misfit_unit;
}

void isocharge_predict(const float charge_pC[ISOCHARGE_ELECTRODES], float contact[7])
{
    float answers[$answers];

    answers_of(charge_pC, answers);
    contact_of(answers, contact);
}

/* Whether a ray from the point to the right crosses an odd number of edges of the working area. */
static int inside_area(float x, float y)
{
    static const float corner[2 * ISOCHARGE_AREA_CORNERS] = ISOCHARGE_AREA_MM;
    const float *start = corner + 2 * (ISOCHARGE_AREA_CORNERS - 1);
    int inside = 0;

    for (int i = 0; i < ISOCHARGE_AREA_CORNERS; ++i) {
        const float *end = corner + 2 * i;

        if ((start[1] > y) != (end[1] > y) && x < start[0] + (y - start[1]) * (end[0] - start[0]) / (end[1] - start[1]))
            inside = !inside;
        start = end;
    }
    return inside;
}

unsigned isocharge_flags(const float contact[7])
{
    const float x = contact[0], y = contact[1], force = contact[2], misfit = contact[6];
    const float from_centre_x = x - ISOCHARGE_CENTRE_X_MM, from_centre_y = y - ISOCHARGE_CENTRE_Y_MM;
    const float squared_distance = from_centre_x * from_centre_x + from_centre_y * from_centre_y;
    unsigned flags = 0;

    if (force < ISOCHARGE_MIN_FORCE_N || force > ISOCHARGE_MAX_FORCE_N || !inside_area(x, y))
        flags |= ISOCHARGE_OUTSIDE;
    if (squared_distance > ISOCHARGE_BEYOND_MM * ISOCHARGE_BEYOND_MM || force > ISOCHARGE_BEYOND_N)
        flags |= ISOCHARGE_BEYOND;
    if (misfit > ISOCHARGE_MISFIT_LIMIT)
        flags |= ISOCHARGE_MISFIT;
    if (force > ISOCHARGE_YIELD_FORCE_N)
        flags |= ISOCHARGE_STRESS;
    return flags;
}

/* From cosines to correlations: always those of a valid covariance. */
$table
void isocharge_predict_all(const float charge_pC[ISOCHARGE_ELECTRODES], float contact[10])
{
    float answers[$answers];

    answers_of(charge_pC, answers);
    contact_of(answers, contact);
    for (int i = 0; i < 3; ++i) {
        contact[7 + i] = 0.0f;
        for (int k = 0; k < $cosines; ++k)
            contact[7 + i] += COSINES[3 * k + i] * cosf(answers[$first + k]);
    }
}
