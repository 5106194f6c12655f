/* What the tests call through ctypes: many presses, frames or bytes in one call, with plain arrays. */
#include "isocharge_chain.c"
#include "isocharge_frames.c"

void bridge_predict(const float *charge_pC, int count, int times, float *contact)
{
    for (int time = 0; time < times; ++time)
        for (int row = 0; row < count; ++row)
#if ISOCHARGE_CONTACT_NUMBERS == 10
            isocharge_predict_all(charge_pC + row * ISOCHARGE_ELECTRODES, contact + 10 * row);
#else
            isocharge_predict(charge_pC + row * ISOCHARGE_ELECTRODES, contact + 7 * row);
#endif
}

void bridge_flags(const float *contact, int count, unsigned *flags)
{
    for (int row = 0; row < count; ++row)
        flags[row] = isocharge_flags(contact + 7 * row);
}

void bridge_chain(const double *value, const double *t_s, const double *dt_s, const int *limited, const int *tare,
                  int count, double *charge_pC, double *tare_pC, int *contact, unsigned *flags)
{
    static isocharge_chain chain;

    isocharge_chain_start(&chain);
    for (int row = 0; row < count; ++row) {
        isocharge_real values[ISOCHARGE_ELECTRODES];
        isocharge_reading reading;

        if (tare[row])
            isocharge_chain_tare(&chain);
        for (int k = 0; k < ISOCHARGE_ELECTRODES; ++k)
            values[k] = (isocharge_real)value[row * ISOCHARGE_ELECTRODES + k];
        isocharge_chain_advance(&chain, values, t_s[row], (isocharge_real)dt_s[row], limited[row], &reading);
        for (int k = 0; k < ISOCHARGE_ELECTRODES; ++k) {
            charge_pC[row * ISOCHARGE_ELECTRODES + k] = reading.charge_pC[k];
            tare_pC[row * ISOCHARGE_ELECTRODES + k] = reading.tare_pC[k];
        }
        contact[row] = reading.contact;
        flags[row] = reading.flags;
    }
}

/* Frames of a piece of a stream: seq, t_us, n, flags of each in `head`, its charges in `charge_pC` (255 each). */
int bridge_frames(const uint8_t *bytes, int count, unsigned long counts[4], uint32_t *head, float *charge_pC)
{
    static isocharge_parser parser;
    static isocharge_frame frame;
    int found = 0;

    isocharge_parser_start(&parser);
    for (int k = 0; k < count; ++k) {
        if (!isocharge_parser_feed(&parser, bytes[k], &frame))
            continue;
        head[4 * found] = frame.seq;
        head[4 * found + 1] = frame.t_us;
        head[4 * found + 2] = frame.n;
        head[4 * found + 3] = frame.flags;
        for (int n = 0; n < frame.n; ++n)
            charge_pC[255 * found + n] = frame.charge_pC[n];
        ++found;
    }
    counts[0] = parser.frames;
    counts[1] = parser.crc_errors;
    counts[2] = parser.malformed;
    counts[3] = parser.bytes_dropped;
    return found;
}

int bridge_encode(int seq, uint32_t t_us, int n, int flags, const float *charge_pC, uint8_t *bytes)
{
    static isocharge_frame frame;

    frame.seq = (uint16_t)seq;
    frame.t_us = t_us;
    frame.n = (uint8_t)n;
    frame.flags = (uint8_t)flags;
    for (int k = 0; k < n; ++k)
        frame.charge_pC[k] = charge_pC[k];
    return (int)isocharge_frame_encode(&frame, bytes);
}

void bridge_clock(const uint32_t *t_us, int count, double *t_s, double *dt_s)
{
    isocharge_clock clock;

    isocharge_clock_start(&clock);
    for (int k = 0; k < count; ++k)
        dt_s[k] = isocharge_clock_read(&clock, t_us[k], t_s + k);
}
