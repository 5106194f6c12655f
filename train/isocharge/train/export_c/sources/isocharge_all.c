/* From cosines to correlations: always those of a valid covariance. */
$table
void isocharge_predict_all(const float charge_pC[ISOCHARGE_ELECTRODES], float contact[10])
{
    float answers[$answers];

    answers_of(charge_pC, answers);
    contact_of(answers, contact);
    for (int i = 0; i < 3; ++i) {
        contact[7 + i] = 0.0f;
        for (int k = 0; k < $cosines; ++k)
            contact[7 + i] += COSINES[3 * k + i] * cosf(answers[$first + k]);
    }
}
