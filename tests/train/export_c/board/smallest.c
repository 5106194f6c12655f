/* The smallest program that predicts: what it takes of flash and RAM is the network's, with its functions. */
#include "isocharge_model.h"

volatile float charge_pC[ISOCHARGE_ELECTRODES], contact[7];

int main(void)
{
    float in[ISOCHARGE_ELECTRODES], out[7];

    for (int k = 0; k < ISOCHARGE_ELECTRODES; ++k)
        in[k] = charge_pC[k];
    isocharge_predict(in, out);
    for (int k = 0; k < 7; ++k)
        contact[k] = out[k];
    return 0;
}
