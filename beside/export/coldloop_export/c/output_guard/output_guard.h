@GENERATED@
/* The output guard of the control PLC: bounds, rate window and slew limit of the outputs, whatever is asked for.
 *
 *     guard_restart(applied);                          once, with the outputs as they are
 *     guard_scan(tick, update, wanted, applied);       in every scan
 *     guard_resume(tick, applied);                     when something else has driven the outputs meanwhile
 *     guard_judge(tick, ..., rows, length);            when a sequence of inputs has come
 *
 * A tick is @TICK_S@ s; ticks never go back. There is one guard: its state is static. Nothing is allocated.
 */
#ifndef OUTPUT_GUARD_H
#define OUTPUT_GUARD_H

#include <stdbool.h>
#include <stdint.h>

#define N_INPUTS @INPUTS@
/* Rows of a sequence; also ticks until it begins. */
#define MOST_ROWS @ROWS@
/* Largest tick: integers have 32 bits. */
#define LARGEST_TICK (INT32_MAX - 0x10000)

typedef enum { GUARD_ACCEPTED, GUARD_OUT_OF_RANGE, GUARD_RATE_EXCEEDED, GUARD_REFUSED } Judgement;

/* Begin: `applied` has been applied for ever. False, and nothing happens, if one of them is no finite number. */
bool guard_restart(const float applied[N_INPUTS]);

/* Go on from `applied`, which something else has applied at `tick`; what is no finite number is as it was.
 * False, and nothing happens, before the first restart, and for ticks below 0 or above LARGEST_TICK. */
bool guard_resume(int32_t tick, const float applied[N_INPUTS]);

/* Decide what is applied at `tick` where `wanted` is asked for; what is no finite number asks for what was applied
 * before the rate window began. `update`: a sequence begins at this tick. False, and nothing happens, as above. */
bool guard_scan(int32_t tick, bool update, const float wanted[N_INPUTS], float applied[N_INPUTS]);

/* Judge a sequence of `length` rows, one for each tick from `first_tick` on: is each of them in range, and would all be
 * applied as they are? From `tick` until then the `coming` rows of `meanwhile` are played, and then what is applied is
 * held. GUARD_REFUSED before the first restart, and for lengths or ticks that cannot be. Nothing is changed. */
Judgement guard_judge(int32_t tick, const float (*meanwhile)[N_INPUTS], int32_t coming, int32_t first_tick,
                      const float (*rows)[N_INPUTS], int32_t length);

#endif
