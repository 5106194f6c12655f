// Where a film is touched and how hard, on a board with a floating-point unit (Cortex-M4F or M7, ESP32, RP2350).
//
// Analog inputs are read at a steady rate, in the order of the electrodes. What they count is turned into pC by the
// offset and gain in isocharge_device.h: export with --device, or the chain takes counts for pC. Lines go out as
// `>name:value`, which serial plotters draw. With SEND_FRAMES set to 1 the charges go out as binary frames instead,
// for `isocharge serve stream` on a host.
#include "isocharge_chain.h"
#include "isocharge_frames.h"

#ifndef SEND_FRAMES
#define SEND_FRAMES 0
#endif

static const int PIN[] = {$pins};
static const uint32_t PERIOD_US = 5000;

static isocharge_chain chain;
static isocharge_clock board_clock;

void setup()
{
    Serial.begin(115200);
    isocharge_chain_start(&chain);
    isocharge_clock_start(&board_clock);
}

static void send_frame(const isocharge_reading &reading, uint32_t now_us)
{
    static isocharge_frame frame;
    static uint8_t bytes[ISOCHARGE_FRAME_BYTES(ISOCHARGE_ELECTRODES)];

    ++frame.seq;
    frame.t_us = now_us;
    frame.n = ISOCHARGE_ELECTRODES;
    for (int k = 0; k < ISOCHARGE_ELECTRODES; ++k)
        frame.charge_pC[k] = (float)reading.raw_pC[k];
    Serial.write(bytes, isocharge_frame_encode(&frame, bytes));
}

static void print_contact(const isocharge_reading &reading)
{
    static const char *const NAME[] = ISOCHARGE_CONTACT_FIELDS;
    float charge_pC[ISOCHARGE_ELECTRODES], contact[7];

    if (!reading.contact)
        return;
    for (int k = 0; k < ISOCHARGE_ELECTRODES; ++k)
        charge_pC[k] = (float)reading.charge_pC[k];
    isocharge_predict(charge_pC, contact);
    for (int k = 0; k < 7; ++k) {
        Serial.print(">");
        Serial.print(NAME[k]);
        Serial.print(":");
        Serial.println(contact[k], 4);
    }
}

void loop()
{
    const uint32_t now_us = micros();
    double time_s, step_s;
    isocharge_real value[ISOCHARGE_ELECTRODES];
    isocharge_reading reading;

    if (now_us - board_clock.last_us < PERIOD_US)
        return;
    step_s = isocharge_clock_read(&board_clock, now_us, &time_s);
    for (int k = 0; k < ISOCHARGE_ELECTRODES; ++k)
        value[k] = (isocharge_real)analogRead(PIN[k]);
    isocharge_chain_advance(&chain, value, time_s, (isocharge_real)step_s, 0, &reading);
    if (SEND_FRAMES)
        send_frame(reading, now_us);
    else
        print_contact(reading);
}
