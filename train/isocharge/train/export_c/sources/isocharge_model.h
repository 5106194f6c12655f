/* $label_comment: charges of a film to where and how hard it is touched. Written by isocharge train export-c. */
#ifndef ISOCHARGE_MODEL_H
#define ISOCHARGE_MODEL_H

#include <math.h>

#ifdef __cplusplus
extern "C" {
#endif

#define ISOCHARGE_MODEL $label_string
#define ISOCHARGE_SENSOR $sensor
#define ISOCHARGE_ELECTRODES $electrode_count
#define ISOCHARGE_ELECTRODE_NAMES {$electrode_names}
#define ISOCHARGE_CONTACT_FIELDS {$field_names}
#define ISOCHARGE_CONTACT_NUMBERS $field_count

/* What the model was trained for: the corners x, y of the working area in mm, the range of forces, the largest misfit of
   a single contact, and the force above which the film yields. */
#define ISOCHARGE_AREA_CORNERS $corner_count
#define ISOCHARGE_AREA_MM {$corners}
#define ISOCHARGE_MIN_FORCE_N $min_force
#define ISOCHARGE_MAX_FORCE_N $max_force
#define ISOCHARGE_MISFIT_LIMIT $misfit_limit
#define ISOCHARGE_YIELD_FORCE_N $yield_force

/* Farther from the centre of the working area, or harder, no contact is a measurement. */
#define ISOCHARGE_CENTRE_X_MM $centre_x
#define ISOCHARGE_CENTRE_Y_MM $centre_y
#define ISOCHARGE_BEYOND_MM $beyond_mm
#define ISOCHARGE_BEYOND_N $beyond_N

/* Bits of the flags of a contact. They differ from those of isocharge_chain.h, so that both fit into one number. */
#define ISOCHARGE_OUTSIDE 0x100u /* outside the working area, or outside the range of forces */
#define ISOCHARGE_BEYOND 0x200u  /* so far outside that the numbers are no measurement */
#define ISOCHARGE_MISFIT 0x400u  /* the charges fit no single contact */
#define ISOCHARGE_STRESS 0x800u  /* the film yields: a dent stays */

/* The contact of one press. It needs no memory but its stack, and may run on several threads at once.

   charge_pC  touch charges, pC, in the order of ISOCHARGE_ELECTRODE_NAMES. Any number may come: charges are taken as at
              least $low and at most $high pC, as in the ONNX file, and where one is NaN all answers are NaN.
   contact    x_mm, y_mm, force_N, their standard deviations x_std_mm, y_std_mm, force_std_N, and the misfit: distance
              of the charges from the nearest single contact that the model knows, in standard deviations. */
void isocharge_predict(const float charge_pC[ISOCHARGE_ELECTRODES], float contact[7]);

/* The reasons not to trust a contact of isocharge_predict, as bits; 0 if there is none. */
unsigned isocharge_flags(const float contact[7]);

/* The same with xy_correlation, xF_correlation and yF_correlation behind: how the errors of position and force go
   together, -1 to 1. */
void isocharge_predict_all(const float charge_pC[ISOCHARGE_ELECTRODES], float contact[10]);

#ifdef __cplusplus
}
#endif

#endif
