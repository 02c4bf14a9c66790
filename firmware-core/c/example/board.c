/* An STM32F405 from reset to main, as little as there has to be. printf and the exit code go to the
   debugger, which QEMU is, by semihosting (rdimon.specs). */
#include <stdint.h>
#include <stdlib.h>

#include "board.h"

extern uint32_t stack_top[], data_start[], data_end[], data_in_flash[], bss_start[], bss_end[];
extern void initialise_monitor_handles(void);
int main(void);

_Noreturn void reset(void);
static _Noreturn void fault(void);

#define CPACR (*(volatile uint32_t *)0xE000ED88)

/* Where the stack begins, and the 15 exceptions of the core: reset, then faults; no one asks for others. */
__attribute__((section(".vectors"), used)) static const struct {
    uint32_t *stack;
    void (*exceptions[15])(void);
} vectors = {stack_top, {reset, fault, fault, fault, fault, fault}};

_Noreturn void reset(void) {
    /* The library, like everything compiled with -mfloat-abi=hard, uses the floating-point unit, which
       is off after a reset. */
    CPACR |= 0xFu << 20;
    __asm__ volatile("dsb\n isb" ::: "memory");
    for (uint32_t *to = data_start, *from = data_in_flash; to < data_end;) {
        *to++ = *from++;
    }
    for (uint32_t *to = bss_start; to < bss_end;) {
        *to++ = 0;
    }
    initialise_monitor_handles();
    exit(main());
}

static _Noreturn void fault(void) {
    _Exit(3);
}

/* Nothing here begins or ends before or after main. */
void _init(void) {}
void _fini(void) {}

/* Below this function's own frame the stack is nobody's. */
#define PAINTED 8192
#define PAINT 0xA5A5A5A5u

__attribute__((noinline)) size_t stack_of(void (*work)(void)) {
    uint32_t *top;
    __asm__ volatile("mov %0, sp" : "=r"(top));
    volatile uint32_t *bottom = top - PAINTED;
    for (volatile uint32_t *word = bottom; word < top; word++) {
        *word = PAINT;
    }
    work();
    volatile uint32_t *deepest = bottom;
    while (deepest < top && *deepest == PAINT) {
        deepest++;
    }
    return (size_t)((uintptr_t)top - (uintptr_t)deepest);
}
