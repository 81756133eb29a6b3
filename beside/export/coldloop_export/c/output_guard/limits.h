@GENERATED@
#ifndef LIMITS_H
#define LIMITS_H

#include "kernels.h"

extern const Limits limits;

@DECLARED@
#endif
