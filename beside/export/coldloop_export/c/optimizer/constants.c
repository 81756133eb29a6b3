@GENERATED@
#include <math.h>
#include <string.h>

#include "constants.h"

@LITERALS@
@ARRAYS@
const Constants constants = @OF_CONSTANTS@;

const @METHOD@ method = @OF_METHOD@;

const @RULE@ rules[@COUNT@] = {
@OF_RULES@};

const @BEGIN@ starts[@COUNT@] = {
@OF_STARTS@};

@SUMMING@