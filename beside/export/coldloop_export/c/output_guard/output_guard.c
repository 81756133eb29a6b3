@GENERATED@
#include <math.h>

#include "limits.h"
#include "output_guard.h"

static GuardState state;
static GuardState twin; /* what a sequence that is judged is played to */
static bool begun = false;

static bool in_time(int32_t tick) { return begun && tick >= 0 && tick <= LARGEST_TICK; }

/* Numbers as the kernels take them. */
static void widen(const float *values, double *wide, int32_t count) {
    for (int32_t i = 0; i < count; i += 1) {
        wide[i] = (double)values[i];
    }
}

bool guard_restart(const float applied[N_INPUTS]) {
    double wide[N_INPUTS];
    widen(applied, wide, N_INPUTS);
    for (int32_t i = 0; i < N_INPUTS; i += 1) {
        if (!isfinite(wide[i])) {
            return false;
        }
    }
    begin(&state, &limits, wide);
    begun = true;
    return true;
}

bool guard_resume(int32_t tick, const float applied[N_INPUTS]) {
    if (!in_time(tick)) {
        return false;
    }
    double wide[N_INPUTS];
    widen(applied, wide, N_INPUTS);
    resume(&state, &limits, tick, wide);
    return true;
}

bool guard_scan(int32_t tick, bool update, const float wanted[N_INPUTS], float applied[N_INPUTS]) {
    if (!in_time(tick)) {
        return false;
    }
    double wide[N_INPUTS];
    widen(wanted, wide, N_INPUTS);
    admit(&state, &limits, tick, wide, update);
    for (int32_t i = 0; i < N_INPUTS; i += 1) {
        applied[i] = (float)state.applied[i];
    }
    return true;
}

Judgement guard_judge(int32_t tick, const float (*meanwhile)[N_INPUTS], int32_t coming, int32_t first_tick,
                      const float (*rows)[N_INPUTS], int32_t length) {
    static double before[MOST_ROWS * N_INPUTS], wide[MOST_ROWS * N_INPUTS];
    if (!in_time(tick) || !in_time(first_tick) || length < 1 || length > MOST_ROWS || coming < 0 ||
        first_tick - tick > MOST_ROWS || coming > first_tick - tick) {
        return GUARD_REFUSED;
    }
    for (int32_t k = 0; k < coming; k += 1) {
        widen(meanwhile[k], &before[k * N_INPUTS], N_INPUTS);
    }
    for (int32_t k = 0; k < length; k += 1) {
        widen(rows[k], &wide[k * N_INPUTS], N_INPUTS);
        if (!in_range(&limits, &wide[k * N_INPUTS])) {
            return GUARD_OUT_OF_RANGE;
        }
    }
    const bool passes = judge(&state, &twin, &limits, tick, before, 0, coming, first_tick, wide, length);
    return passes ? GUARD_ACCEPTED : GUARD_RATE_EXCEEDED;
}
