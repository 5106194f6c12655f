    for (int i = $begin; i < $end; i += $n_row) {
        const $number_type *w = ${name}_weights + $n_output * i;
        const float $inputs;

        for (int j = 0; j < $n_output; ++j)
            y[j] += $products;
    }
