/* Reset: memory, the floating-point unit, main, and the end of the emulation with its result. */
#include <stdint.h>

extern uint32_t data_in_flash[], data_begin[], data_end[], bss_begin[], bss_end[], stack_top[];
int main(void);

int semihosting(int operation, void *argument)
{
    register int r0 __asm__("r0") = operation;
    register void *r1 __asm__("r1") = argument;

    __asm__ volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

static void leave(int result)
{
    uint32_t block[2] = {0x20026, (uint32_t)result}; /* ADP_Stopped_ApplicationExit */

    semihosting(0x20, block); /* SYS_EXIT_EXTENDED */
    for (;;) {
    }
}

static void fault(void) { leave(99); }

void reset(void)
{
    uint32_t *from = data_in_flash;

    for (uint32_t *to = data_begin; to < data_end;)
        *to++ = *from++;
    for (uint32_t *to = bss_begin; to < bss_end;)
        *to++ = 0;
    *(volatile uint32_t *)0xE000ED88 |= 0xF << 20; /* CPACR: coprocessors 10 and 11 */
    __asm__ volatile("dsb\n\tisb");
    leave(main());
}

__attribute__((section(".vectors"), used)) static void *const VECTORS[16] = {
    (void *)stack_top,   (void *)reset,       (void *)fault,       (void *)fault,
    (void *)fault,       (void *)fault,       (void *)fault,
};
