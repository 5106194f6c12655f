/* ln(a / b) of two positive numbers; where they are close, their difference is exact, and so it has all its digits. */
static float log_ratio(float a, float b)
{
    const float ratio = a / b;

    return ratio > 0.5f && ratio < 2.0f ? log1pf((a - b) / b) : logf(ratio);
}

$arrays
/* The logarithm of one charge, and by how much those of the others differ from it. */
static void features(const float charge_pC[$electrodes], float logs[$electrodes])
{
    for (int i = 0; i < $electrodes; ++i)
        logs[i] = clip(charge_pC[i], LOW[i], HIGH[i]) * FACTOR[i];
    for (int i = 1; i < $electrodes; ++i)
        logs[i] = log_ratio(logs[i], logs[0]);
    logs[0] = logf(logs[0]);
}
