/* Our binary frame: bytes in, frames out, and back.

   COBS of version u8, seq u16, t_us u32, n u8, flags u8, n x f32 pC, CRC-16/CCITT-FALSE; then a zero byte.
   All little-endian. A zero occurs only at the end of a frame, so a damaged frame costs itself and nothing else. */
#ifndef ISOCHARGE_FRAMES_H
#define ISOCHARGE_FRAMES_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define ISOCHARGE_FRAME_SATURATED 0x01u                     /* in flags: an amplifier is at its limit */
#define ISOCHARGE_FRAME_PAYLOAD(n) (9 + 4 * (n) + 2)        /* bytes of a frame of n charges */
#define ISOCHARGE_FRAME_PIECE(n) (ISOCHARGE_FRAME_PAYLOAD(n) + 1 + ISOCHARGE_FRAME_PAYLOAD(n) / 254)
#define ISOCHARGE_FRAME_BYTES(n) (ISOCHARGE_FRAME_PIECE(n) + 1) /* the same with stuffing and the zero behind it */

typedef struct {
    uint16_t seq;
    uint32_t t_us;
    uint8_t n, flags;
    float charge_pC[255];
} isocharge_frame;

typedef struct {
    uint8_t piece[ISOCHARGE_FRAME_PIECE(255)];
    size_t length;
    int overlong;
    unsigned long frames, crc_errors, malformed, bytes_dropped;
} isocharge_parser;

typedef struct {
    uint32_t last_us;
    uint64_t device_us;
    int running;
} isocharge_clock;

/* The state before the first byte. */
void isocharge_parser_start(isocharge_parser *parser);

/* Take the next byte; returns 1 if an intact frame ends with it. What is damaged is counted and dropped. */
int isocharge_parser_feed(isocharge_parser *parser, uint8_t byte, isocharge_frame *frame);

/* Write the bytes of a frame with the zero behind it; returns their number, at most ISOCHARGE_FRAME_BYTES(n). */
size_t isocharge_frame_encode(const isocharge_frame *frame, uint8_t *bytes);

/* The state before the first frame. */
void isocharge_clock_start(isocharge_clock *clock);

/* Seconds since the frame before, 0 for the first one and where the clock jumped; *t_s is the clock without its wraps. */
double isocharge_clock_read(isocharge_clock *clock, uint32_t t_us, double *t_s);

#ifdef __cplusplus
}
#endif

#endif
