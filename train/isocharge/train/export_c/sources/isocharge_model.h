/* $label: charges of a film to where and how hard it is touched. Written by isocharge train export-c. */
#ifndef ISOCHARGE_MODEL_H
#define ISOCHARGE_MODEL_H

#ifdef __cplusplus
extern "C" {
#endif

#define ISOCHARGE_MODEL $model
#define ISOCHARGE_SENSOR $sensor
#define ISOCHARGE_ELECTRODES $electrodes
#define ISOCHARGE_ELECTRODE_NAMES {$names}
#define ISOCHARGE_CONTACT_FIELDS {$fields}
#define ISOCHARGE_CONTACT_NUMBERS $numbers

/* The contact of one press. It needs no memory but its stack, and may run on several threads at once.

   charge_pC  touch charges, pC, in the order of ISOCHARGE_ELECTRODE_NAMES. Any number may come: charges are taken as at
              least $low and at most $high pC, as in the ONNX file, and where one is NaN all answers are NaN.
   contact    x_mm, y_mm, force_N, their standard deviations x_std_mm, y_std_mm, force_std_N, and the misfit: distance
              of the charges from the nearest single contact that the model knows, in standard deviations. */
void isocharge_predict(const float charge_pC[ISOCHARGE_ELECTRODES], float contact[7]);
$all
#ifdef __cplusplus
}
#endif

#endif
