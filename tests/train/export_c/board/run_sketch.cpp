/* Runs the sketch: each line of stdin is a time in us and what the pins read. */
#include "Arduino.h"

#include SKETCH

int main()
{
    setup();
    while (scanf("%lu", &clock_us) == 1) {
        for (int k = 0; k < ISOCHARGE_ELECTRODES; ++k)
            if (scanf("%d", pins + k) != 1)
                return 1;
        loop();
    }
    return 0;
}
