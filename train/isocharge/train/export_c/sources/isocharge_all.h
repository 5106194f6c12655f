
/* The same with xy_correlation, xF_correlation and yF_correlation behind: how the errors of position and force go
   together, -1 to 1. */
void isocharge_predict_all(const float charge_pC[ISOCHARGE_ELECTRODES], float contact[10]);
