/* Our binary frame; see isocharge_frames.h. */
#include "isocharge_frames.h"

#include <string.h>

#define VERSION 1
#define HEAD 9
#define LONGEST sizeof((isocharge_parser *)0)->piece

static uint16_t crc16(const uint8_t *bytes, size_t length)
{
    uint16_t crc = 0xFFFF;

    for (size_t n = 0; n < length; ++n) {
        crc = (uint16_t)(crc ^ (bytes[n] << 8));
        for (int bit = 0; bit < 8; ++bit)
            crc = (uint16_t)(crc & 0x8000 ? (crc << 1) ^ 0x1021 : crc << 1);
    }
    return crc;
}

static uint32_t number(const uint8_t *bytes, int size)
{
    uint32_t value = 0;

    while (size-- > 0)
        value = value << 8 | bytes[size];
    return value;
}

static uint8_t *put(uint8_t *bytes, uint32_t value, int size)
{
    for (; size-- > 0; value >>= 8)
        *bytes++ = (uint8_t)value;
    return bytes;
}

/* Take the byte stuffing out, in place; returns the length, or -1 if a distance points beyond the end. */
static long unstuff(uint8_t *bytes, size_t length)
{
    size_t from = 0, to = 0;

    while (from < length) {
        const size_t code = bytes[from++];

        if (code - 1 > length - from)
            return -1;
        memmove(bytes + to, bytes + from, code - 1);
        from += code - 1;
        to += code - 1;
        if (code < 255 && from < length)
            bytes[to++] = 0;
    }
    return (long)to;
}

/* Read a piece between two zeros; what it is if it is no frame is counted. */
static int take(isocharge_parser *parser, isocharge_frame *frame)
{
    const uint8_t *body = parser->piece;
    const long length = unstuff(parser->piece, parser->length);
    const long end = length - 2;

    if (end < HEAD) {
        ++parser->malformed;
        return 0;
    }
    if (crc16(body, (size_t)end) != number(body + end, 2)) {
        ++parser->crc_errors;
        return 0;
    }
    if (body[0] != VERSION || end != HEAD + 4 * (long)body[7]) {
        ++parser->malformed;
        return 0;
    }
    frame->seq = (uint16_t)number(body + 1, 2);
    frame->t_us = number(body + 3, 4);
    frame->n = body[7];
    frame->flags = body[8];
    for (int k = 0; k < frame->n; ++k) {
        const uint32_t bits = number(body + HEAD + 4 * k, 4);
        memcpy(frame->charge_pC + k, &bits, 4);
    }
    ++parser->frames;
    return 1;
}

void isocharge_parser_start(isocharge_parser *parser) { memset(parser, 0, sizeof *parser); }

int isocharge_parser_feed(isocharge_parser *parser, uint8_t byte, isocharge_frame *frame)
{
    const size_t length = parser->length;
    int intact = 0;

    if (byte != 0 && length < LONGEST && !parser->overlong) {
        parser->piece[parser->length++] = byte;
        return 0;
    }
    if (byte != 0) {
        parser->overlong = 1;
        parser->bytes_dropped += length + 1;
        parser->length = 0;
        return 0;
    }
    if (parser->overlong)
        ++parser->malformed;
    else if (length > 0)
        intact = take(parser, frame);
    if (!intact && (length > 0 || parser->overlong))
        parser->bytes_dropped += length + 1;
    parser->length = 0;
    parser->overlong = 0;
    return intact;
}

size_t isocharge_frame_encode(const isocharge_frame *frame, uint8_t *bytes)
{
    const size_t length = ISOCHARGE_FRAME_PAYLOAD((size_t)frame->n);
    uint8_t *payload = bytes + ISOCHARGE_FRAME_BYTES((size_t)frame->n) - length; /* stuffed towards the front */
    uint8_t *end = put(put(put(put(put(payload, VERSION, 1), frame->seq, 2), frame->t_us, 4), frame->n, 1),
                       frame->flags, 1);
    uint8_t *code = bytes, *to = bytes + 1;

    for (int k = 0; k < frame->n; ++k) {
        uint32_t bits;
        memcpy(&bits, frame->charge_pC + k, 4);
        end = put(end, bits, 4);
    }
    put(end, crc16(payload, length - 2), 2);
    for (size_t n = 0; n < length; ++n) {
        const uint8_t byte = payload[n];

        if (byte != 0)
            *to++ = byte;
        if (byte == 0 || (to - code == 255 && n + 1 < length)) {
            *code = (uint8_t)(to - code);
            code = to++;
        }
    }
    *code = (uint8_t)(to - code);
    *to++ = 0;
    return (size_t)(to - bytes);
}

void isocharge_clock_start(isocharge_clock *clock) { memset(clock, 0, sizeof *clock); }

double isocharge_clock_read(isocharge_clock *clock, uint32_t t_us, double *t_s)
{
    uint32_t step_us = t_us - clock->last_us;
    const uint32_t late_us = clock->last_us - t_us;

    if (clock->running && late_us <= 1000000u && late_us <= clock->device_us) { /* a frame in another order */
        clock->device_us -= late_us;
        step_us = 0;
    } else if (!clock->running || step_us >= 0x80000000u) {
        clock->device_us = t_us;
        step_us = 0;
    } else {
        clock->device_us += step_us;
    }
    clock->last_us = t_us;
    clock->running = 1;
    *t_s = 1e-6 * (double)clock->device_us;
    return 1e-6 * (double)step_us;
}
