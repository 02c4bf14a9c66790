/* What the example wants of the board. */
#ifndef BOARD_H
#define BOARD_H

#include <stddef.h>

/* The bytes of stack that `work` takes, itself included: it runs on a stack painted beforehand. */
size_t stack_of(void (*work)(void));

#endif
