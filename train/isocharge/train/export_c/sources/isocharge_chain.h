/* The signal chain: from what a board counts to touch charges and whether something touches.

   The stages are those of isocharge.serve.signal_chain, in the same order: gain, saturation, hum, tare, leak, touch,
   thermal. Which of them run, and with which numbers, is in isocharge_device.h. It needs no memory but the state that
   the caller holds. With ISOCHARGE_CHAIN_FLOAT defined it computes in float, for processors without double. */
#ifndef ISOCHARGE_CHAIN_H
#define ISOCHARGE_CHAIN_H

#include "isocharge_device.h"
#include "isocharge_model.h"

#ifdef __cplusplus
extern "C" {
#endif

#ifdef ISOCHARGE_CHAIN_FLOAT
typedef float isocharge_real;
#else
typedef double isocharge_real;
#endif

/* Bits of a reading's flags. */
#define ISOCHARGE_TARE 0x01u         /* no tare yet, so no contact either */
#define ISOCHARGE_SATURATED 0x02u    /* a charge is at the limit, or was in this press */
#define ISOCHARGE_NEGATIVE 0x04u     /* the charges are well below zero */
#define ISOCHARGE_THERMAL 0x08u      /* the film has warmed or cooled in this press; it was subtracted */
#define ISOCHARGE_BLIND 0x10u        /* temperature is inseparable from force at this position */
#define ISOCHARGE_INVALID 0x20u      /* a value cannot be a charge; nothing was computed */
#define ISOCHARGE_DRIFT 0x80u        /* the contact began so slowly that the charge at rest may have drifted */
#define ISOCHARGE_TARE_FAILED 0x40u  /* the film was not left alone for as long as the device file waits */
#define ISOCHARGE_GAP 0x1000u        /* missing or invalid frames may have falsified the charge of this touch */

typedef struct {
    isocharge_real raw_pC[ISOCHARGE_ELECTRODES];    /* what the device sent, as charges */
    isocharge_real charge_pC[ISOCHARGE_ELECTRODES]; /* touch charges; 0 where there is no tare, or flags say invalid */
    isocharge_real tare_pC[ISOCHARGE_ELECTRODES];   /* what was subtracted; 0 likewise */
    int contact;                                    /* whether something touches */
    unsigned flags;
} isocharge_reading;

typedef struct {
    isocharge_real invalid_s; /* time of the invalid frames since the last valid one */
#if ISOCHARGE_HUM_ON
    isocharge_real hum_re[ISOCHARGE_ELECTRODES], hum_im[ISOCHARGE_ELECTRODES]; /* amplitude and phase, pC */
    isocharge_real turn_re, turn_im;                 /* the mains at the frame that is compared */
    isocharge_real hum_raw_pC[ISOCHARGE_ELECTRODES]; /* its charges */
    isocharge_real hum_waited_s;                     /* time since then */
    isocharge_real hum_learned_s;                    /* time over which the hum has been learned */
    int hum_running;
#endif
#if ISOCHARGE_TARE_ON
    isocharge_real waiting_pC[ISOCHARGE_TARE_FRAMES][ISOCHARGE_ELECTRODES]; /* the latest frames while there is none */
    long waiting, next, frames;
    int patient;
#endif
    int tared;
    isocharge_real tare_pC[ISOCHARGE_ELECTRODES], noise_pC[ISOCHARGE_ELECTRODES];
#if ISOCHARGE_LEAK_ON
    int leak_running;
    isocharge_real charge_pC[ISOCHARGE_ELECTRODES], output_pC[ISOCHARGE_ELECTRODES];
    isocharge_real inflow[ISOCHARGE_ELECTRODES], trusted[ISOCHARGE_ELECTRODES], candidate[ISOCHARGE_ELECTRODES];
    isocharge_real inflow_sum[ISOCHARGE_ELECTRODES]; /* inflows in the present interval */
    isocharge_real candidate_age_s, learned_s, hold_s, step_s;
    int inflow_count, falsified;
#endif
    int contact, below, saturated, slow;
#if ISOCHARGE_TOUCH_ON
    isocharge_real peak, rest_s; /* charges of the touch are in units of their thresholds */
    isocharge_real last[ISOCHARGE_ELECTRODES], base[ISOCHARGE_ELECTRODES], mean[ISOCHARGE_ELECTRODES];
    isocharge_real direction[ISOCHARGE_ELECTRODES];
#endif
#if ISOCHARGE_COMMON_MODE_ON
    isocharge_real drift_pC, drift_pC2, waited_s;
    int blind;
#endif
} isocharge_chain;

/* The state before the first frame. */
void isocharge_chain_start(isocharge_chain *chain);

/* Tare again, however long that takes, and learn the hum again. */
void isocharge_chain_tare(isocharge_chain *chain);

/* Take the next frame through all stages.

   value    as they came, in the device's unit, in the order of the electrodes
   t_s      the device's clock, s; only hum needs it
   dt_s     since the frame before, s; 0 for the first
   limited  whether the device says that an amplifier is at its limit */
void isocharge_chain_advance(isocharge_chain *chain, const isocharge_real value[ISOCHARGE_ELECTRODES], double t_s,
                             isocharge_real dt_s, int limited, isocharge_reading *reading);

#ifdef __cplusplus
}
#endif

#endif
