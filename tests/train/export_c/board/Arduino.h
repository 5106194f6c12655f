/* As much of Arduino as the sketch uses, on a host: the readings come from stdin, what is sent goes to stdout. */
#ifndef ARDUINO_H
#define ARDUINO_H

#include <stddef.h>
#include <stdint.h>
#include <stdio.h>

enum { A0 = 14, A1, A2, A3, A4, A5, A6, A7 };

static unsigned long clock_us; // begins again at 0 with bit 32, as that of a board
static int pins[8];

static inline unsigned long micros(void) { return (uint32_t)clock_us; }

static inline int analogRead(int pin) { return pins[pin - A0]; }

struct Port {
    void begin(long) {}
    void print(const char *text) { fputs(text, stdout); }
    void print(int value) { printf("%d", value); }
    void println(int value) { printf("%d\r\n", value); }
    void println(float value, int digits) { printf("%.*f\r\n", digits, (double)value); }
    size_t write(const uint8_t *bytes, size_t count) { return fwrite(bytes, 1, count, stdout); }
};

static Port Serial;

#endif
