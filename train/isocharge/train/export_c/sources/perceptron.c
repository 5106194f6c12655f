$layers
/* What the last layer and the skip layer give together. */
static void ${name}_answers(const float *restrict logs, float *restrict answers)
{
    float rows[2][$widest], skipped[$n_answer];

    $calls
    ${name}_skip(logs, skipped);
    ${name}_last($last_row, answers);
    for (int j = 0; j < $n_answer; ++j)
        answers[j] += skipped[j];
}
