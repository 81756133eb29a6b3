@GENERATED@
#ifndef TABLES_H
#define TABLES_H

#include "kernels.h"

/* In a file of their own, so that the compiler does not copy them into the code. */
@DECLARED@
/* Sum over the constants and the literals; SUM_OF_CONSTANTS is what it was when they were written. */
uint32_t sum_of_constants(void);
uint32_t sum_of_reals(uint32_t sum, const volatile @REAL@ *values, int32_t count);
uint32_t sum_of_integers(uint32_t sum, const volatile int32_t *values, int32_t count);
#define SUM_OF_CONSTANTS UINT32_C(@SUM@)

#endif
