/* Golden vectors, instructions and stack of a prediction and of a frame of the signal chain, in words of hexadecimal.

   Under `-icount shift=0` QEMU's clock advances 1 ns with each instruction; SysTick counts it at 25 MHz, so one tick is
   40 instructions. It prints: whether an answer differs from the golden vectors; instructions of a loop of known length, of a
   prediction, of a frame out of contact and of one in contact; bytes of stack of a prediction and of a frame. */
#include "isocharge_chain.h"

#include <stdio.h>

#define main golden_main
#define printf(...) ((void)0)
#include "self_test.c"
#undef main

#include <stdint.h>

int semihosting(int operation, void *argument);

#define CSR (*(volatile uint32_t *)0xE000E010)
#define RELOAD (*(volatile uint32_t *)0xE000E014)
#define CURRENT (*(volatile uint32_t *)0xE000E018)

#define TIMES 200
#define INSTRUCTIONS_PER_TICK 40
#define PAINT 0xA5A5A5A5u
#define PAINTED 4096

static isocharge_chain chain;
static isocharge_reading reading;
static float contact_of[7];
static isocharge_real values[ISOCHARGE_ELECTRODES];

static void write_word(uint32_t value)
{
    static char text[10] = "00000000 ";

    for (int k = 7; k >= 0; --k, value >>= 4)
        text[k] = "0123456789abcdef"[value & 15];
    semihosting(4, text); /* SYS_WRITE0 */
}

static void idle(void) {}

static void known_loop(void)
{
    uint32_t n = 1000;

    __asm__ volatile("1: subs %0, #1\n\tnop\n\tnop\n\tbne 1b" : "+r"(n) : : "cc"); /* 4,000 instructions */
}

static void predict(void) { isocharge_predict(CHARGE_PC, contact_of); }

static void advance(void) { isocharge_chain_advance(&chain, values, 1.0, (isocharge_real)0.005, 0, &reading); }

static uint32_t ticks(void (*work)(void))
{
    RELOAD = CURRENT = 0xFFFFFF;
    CSR = 5;
    const uint32_t begin = CURRENT;
    for (int k = 0; k < TIMES; ++k)
        work();
    return (begin - CURRENT) & 0xFFFFFF;
}

static uint32_t instructions(void (*work)(void))
{
    return (ticks(work) - ticks(idle)) * INSTRUCTIONS_PER_TICK / TIMES;
}

static uint32_t stack_bytes(void (*work)(void))
{
    uint32_t *const here = (uint32_t *)__builtin_frame_address(0) - 16;
    uint32_t used = 0;

    for (int k = 1; k <= PAINTED; ++k)
        ((volatile uint32_t *)here)[-k] = PAINT;
    work();
    for (int k = 1; k <= PAINTED; ++k)
        if (((volatile uint32_t *)here)[-k] != PAINT)
            used = 4 * (uint32_t)k;
    return used + 64;
}

int main(void)
{
    int wrong = golden_main();

    write_word((uint32_t)wrong);
    write_word(instructions(known_loop));
    write_word(instructions(predict));
    isocharge_chain_start(&chain);
    for (int k = 0; k < 400; ++k)
        advance();
    write_word(instructions(advance));
    for (int k = 0; k < ISOCHARGE_ELECTRODES; ++k)
        values[k] = 800;
    advance();
    write_word(instructions(advance));
    write_word(stack_bytes(predict));
    write_word(stack_bytes(advance));
    return wrong;
}
