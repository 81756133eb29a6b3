@GENERATED@
#include <math.h>
#include <string.h>

#include "limits.h"

@LITERALS@
@ARRAYS@
const Limits limits = @LIMITS@;

@SUMMING@