@GENERATED@
#ifndef CONSTANTS_H
#define CONSTANTS_H

#include "kernels.h"

extern const Constants constants;
extern const @METHOD@ method;
/* The rule for each fixed updating period in ticks, and what it begins with; those for 0 adapt it. */
extern const @RULE@ rules[@COUNT@];
extern const @BEGIN@ starts[@COUNT@];

@DECLARED@
#endif
