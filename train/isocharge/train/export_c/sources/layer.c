/* $n_input numbers x to $n_output numbers y */
static void $name(const float *restrict x, const float *restrict c, float *restrict y)
{
    for (int j = 0; j < $n_output; ++j)
        y[j] = 0.0f;
$products    for (int j = 0; j < $n_output; ++j)
        y[j] = $result;
}
