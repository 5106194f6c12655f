/* Golden vectors of the model: exits with 0 if this machine answers as onnxruntime did. */
#include "isocharge_model.h"

#include <math.h>
#include <stdio.h>

#define VECTORS $vector_count
#define RELATIVE $relative

/* |a - b| <= RELATIVE max(|b|, FLOOR) */
$floors
$charges
$contacts
$flags
int main(void)
{
    static const char *const field[] = ISOCHARGE_CONTACT_FIELDS;
    float contact[$number_count], worst = 0.0f;
    int row, column, wrong = 0;

    for (row = 0; row < VECTORS; ++row) {
        isocharge_predict_all(CHARGE_PC + row * ISOCHARGE_ELECTRODES, contact);
        for (column = 0; column < $number_count; ++column) {
            const float expected = CONTACT[row * $number_count + column];
            const float apart = fabsf(contact[column] - expected) / fmaxf(fabsf(expected), FLOOR[column]);

            if (!(apart <= RELATIVE)) {
                printf("vector %d: %s: expected %.9g, got %.9g\n", row, field[column], (double)expected,
                       (double)contact[column]);
                ++wrong;
            }
            worst = apart > worst ? apart : worst;
        }
        if (isocharge_flags(CONTACT + row * $number_count) != FLAGS[row]) {
            printf("vector %d: flags: expected %u, got %u\n", row, FLAGS[row],
                   isocharge_flags(CONTACT + row * $number_count));
            ++wrong;
        }
    }
    printf("%s: %d golden vectors, %d wrong numbers, largest difference %.1e of %.1e allowed\n", ISOCHARGE_MODEL,
           VECTORS, wrong, (double)worst, (double)RELATIVE);
    return wrong != 0;
}
