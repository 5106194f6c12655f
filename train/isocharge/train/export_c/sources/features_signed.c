$arrays
/* Charges of any sign: asinh, which is linear where noise is larger than the charge and a logarithm beyond. */
static void features(const float charge_pC[$electrodes], float logs[$electrodes])
{
    for (int i = 0; i < $electrodes; ++i)
        logs[i] = asinhf(clip(charge_pC[i], LOW[i], HIGH[i]) * FACTOR[i]) - MEAN[i];
}
