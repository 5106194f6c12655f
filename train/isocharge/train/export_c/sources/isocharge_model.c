/* The network of $label in single precision. Written by isocharge train export-c. */
#include "isocharge_model.h"

#include <math.h>

$activation
/* A number within two bounds; NaN stays NaN. */
static float clip(float x, float low, float high)
{
    x = x < low ? low : x;
    return x > high ? high : x;
}

$features
$layers
$limits/* What the last layer gives, still without the functions of `contact_of`. */
static void answers_of(const float charge_pC[ISOCHARGE_ELECTRODES], float answers[$answers])
{
    float logs[$electrodes], $rows, skipped[$answers];

    features(charge_pC, logs);
    $calls
}

static void contact_of(const float answers[$answers], float contact[7])
{
    float length = 0.0f;

    for (int i = 0; i < $plane; ++i)
        contact[i] = answers[i];
    for (int i = $plane; i < $stds; ++i)
        contact[i] = expf(answers[i]);
    for (int i = $stds; i < $logs; ++i)
        contact[i] = expf($log_std);
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
$all