$arrays
/* $n_input numbers x to $n_output numbers y. The products of four inputs at a time are added to the outputs. */
static void $name(const float *restrict x, float *restrict y)
{
    for (int j = 0; j < $n_output; ++j)
        y[j] = 0.0f;
    for (int i = 0; i < $n_grouped; i += 4) {
        const $number_type *w = ${name}_weights + $n_output * i;
        const float x0 = x[i], x1 = x[i + 1], x2 = x[i + 2], x3 = x[i + 3];

        for (int j = 0; j < $n_output; ++j)
            y[j] += x0 * (float)w[j] + x1 * (float)w[$n_output + j] + x2 * (float)w[2 * $n_output + j]
                    + x3 * (float)w[3 * $n_output + j];
    }
    for (int i = $n_grouped; i < $n_input; ++i) {
        const $number_type *w = ${name}_weights + $n_output * i;

        for (int j = 0; j < $n_output; ++j)
            y[j] += x[i] * (float)w[j];
    }
    for (int j = 0; j < $n_output; ++j)
        y[j] = $output_expression;
}
