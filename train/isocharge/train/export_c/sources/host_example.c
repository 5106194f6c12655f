/* A host without Python: frames from a serial port in, contacts out, a line of JSON for each frame.

       ./host_example PORT [FRAMES]

   PORT is a device path whose speed is set already (stty -F PORT 115200; USB ports need none), or a file of frames.
   The fields are those of the records of `isocharge serve stream`. It ends after FRAMES frames, or with the file. */
#define _POSIX_C_SOURCE 200809L

#include "isocharge_chain.h"
#include "isocharge_frames.h"
#include "isocharge_model.h"

#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <unistd.h>

#define BYTES_TO_RECOGNISE 8192 /* without one intact frame, after which the port sends no frames of ours */

typedef struct {
    isocharge_parser parser;
    isocharge_clock clock;
    isocharge_chain chain;
    isocharge_frame frame;
} stream;

static const char *const FIELD[] = ISOCHARGE_CONTACT_FIELDS;

static void print_flags(unsigned flags)
{
    static const struct {
        unsigned bit;
        const char *word;
    } WORDS[] = {
        {ISOCHARGE_INVALID, "invalid"},   {ISOCHARGE_TARE, "tare"},       {ISOCHARGE_SATURATED, "saturated"},
        {ISOCHARGE_NEGATIVE, "negative"}, {ISOCHARGE_THERMAL, "thermal"}, {ISOCHARGE_BLIND, "blind"},
        {ISOCHARGE_OUTSIDE, "outside"},   {ISOCHARGE_BEYOND, "beyond"},   {ISOCHARGE_MISFIT, "misfit"},
        {ISOCHARGE_STRESS, "stress"},     {ISOCHARGE_DRIFT, "drift"},     {ISOCHARGE_GAP, "gap"},
    };
    const char *between = "";

    printf("\"flags\": [");
    for (size_t k = 0; k < sizeof WORDS / sizeof *WORDS; ++k)
        if (flags & WORDS[k].bit) {
            printf("%s\"%s\"", between, WORDS[k].word);
            between = ", ";
        }
    printf("]}\n");
}

static void print_record(const isocharge_frame *frame, const isocharge_clock *clock, const isocharge_reading *reading)
{
    float charge_pC[ISOCHARGE_ELECTRODES], contact[7];

    printf("{\"seq\": %u, \"t_device_us\": %llu, \"contact\": %s, ", frame->seq, (unsigned long long)clock->device_us,
           reading->contact ? "true" : "false");
    for (int k = 0; k < ISOCHARGE_ELECTRODES; ++k)
        charge_pC[k] = (float)reading->charge_pC[k];
    isocharge_predict(charge_pC, contact);
    for (int k = 0; k < 7; ++k)
        if (reading->contact)
            printf("\"%s\": %.9g, ", FIELD[k], (double)contact[k]);
        else if (strcmp(FIELD[k], "force_N") == 0 && !(reading->flags & ISOCHARGE_INVALID))
            printf("\"%s\": 0.0, ", FIELD[k]);
        else
            printf("\"%s\": null, ", FIELD[k]);
    print_flags(reading->flags | (reading->contact ? isocharge_flags(contact) : 0));
}

/* Take a frame through clock, chain and network; 0 if the stream cannot go on. */
static int take_frame(stream *in)
{
    isocharge_real value[ISOCHARGE_ELECTRODES];
    isocharge_reading reading;
    double t_s;
    const double dt_s = isocharge_clock_read(&in->clock, in->frame.t_us, &t_s);

    if (in->frame.n != ISOCHARGE_ELECTRODES) {
        fprintf(stderr, "expected %d charges, as the model %s has electrodes; frame %u has %d\n", ISOCHARGE_ELECTRODES,
                ISOCHARGE_MODEL, in->frame.seq, in->frame.n);
        return 0;
    }
    for (int k = 0; k < ISOCHARGE_ELECTRODES; ++k)
        value[k] = (isocharge_real)in->frame.charge_pC[k];
    isocharge_chain_advance(&in->chain, value, t_s, (isocharge_real)dt_s,
                            (in->frame.flags & ISOCHARGE_FRAME_SATURATED) != 0, &reading);
    if (reading.flags & ISOCHARGE_TARE_FAILED) {
        fprintf(stderr, "cannot tare: the film was touched, or is noisy; leave it alone and start again\n");
        return 0;
    }
    print_record(&in->frame, &in->clock, &reading);
    return 1;
}

/* Open a port for raw bytes; a file needs no settings. */
static int open_port(const char *path)
{
    const int port = open(path, O_RDONLY | O_NOCTTY);
    struct termios settings;

    if (port >= 0 && tcgetattr(port, &settings) == 0) {
        settings.c_iflag &= (tcflag_t) ~(IGNBRK | BRKINT | PARMRK | ISTRIP | INLCR | IGNCR | ICRNL | IXON);
        settings.c_oflag &= (tcflag_t)~OPOST;
        settings.c_lflag &= (tcflag_t) ~(ECHO | ECHONL | ICANON | ISIG | IEXTEN);
        settings.c_cflag = (settings.c_cflag & (tcflag_t) ~(CSIZE | PARENB)) | CS8 | CREAD | CLOCAL;
        settings.c_cc[VMIN] = 1;
        settings.c_cc[VTIME] = 0;
        tcsetattr(port, TCSANOW, &settings);
    }
    return port;
}

/* Read until the port ends, or enough frames have come; 0 if all went well. */
static int follow(int port, stream *in, long frames)
{
    uint8_t bytes[256];
    ssize_t count;

    while (frames != 0 && (count = read(port, bytes, sizeof bytes)) != 0) {
        if (count < 0 && errno == EINTR)
            continue;
        if (count < 0) {
            fprintf(stderr, "the port went away: %s\n", strerror(errno));
            return 1;
        }
        for (ssize_t k = 0; k < count && frames != 0; ++k) {
            if (!isocharge_parser_feed(&in->parser, bytes[k], &in->frame))
                continue;
            if (!take_frame(in))
                return 1;
            --frames;
        }
        fflush(stdout);
        if (in->parser.frames == 0 && in->parser.bytes_dropped > BYTES_TO_RECOGNISE)
            break;
    }
    if (in->parser.frames == 0 && frames != 0) {
        fprintf(stderr, "no intact frame came: expected the binary frames of isocharge; check speed and device\n");
        return 1;
    }
    return 0;
}

int main(int count, char **arguments)
{
    static stream in;
    int port, failed;

    if (count < 2 || count > 3) {
        fprintf(stderr, "usage: %s PORT [FRAMES]\n", arguments[0]);
        return 2;
    }
    port = open_port(arguments[1]);
    if (port < 0) {
        fprintf(stderr, "%s: %s\n", arguments[1], strerror(errno));
        return 1;
    }
    isocharge_parser_start(&in.parser);
    isocharge_clock_start(&in.clock);
    isocharge_chain_start(&in.chain);
    failed = follow(port, &in, count == 3 ? strtol(arguments[2], NULL, 10) : -1);
    close(port);
    return failed;
}
