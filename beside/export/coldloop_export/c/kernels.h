@GENERATED@
#ifndef KERNELS_H
#define KERNELS_H

#include <stdbool.h>
#include <stdint.h>

/* Names that the linker sees. */
@NAMES@
#define N_LITERALS @COUNT@
extern const @REAL@ literals[N_LITERALS];

@RECORDS@
@SIGNATURES@

#endif
