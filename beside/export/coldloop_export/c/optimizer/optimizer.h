@GENERATED@
/* The optimiser of a predictive controller: for each update of the control PLC a plan, then a sequence of inputs.
 *
 *     optimizer_restart(0);                  once for each session
 *     optimizer_plan(&update, &plan);        when an update has been latched: send the plan at once
 *     optimizer_solve(&sequence);            then compute the sequence, which begins at plan.next_update_tick
 *     optimizer_answered(late);              when the control PLC has answered
 *
 * A tick is @TICK_S@ s of plant time. There is one optimiser: its state is static. Nothing is allocated, nothing is shared
 * between threads.
 */
#ifndef OPTIMIZER_H
#define OPTIMIZER_H

#include <stdbool.h>
#include <stdint.h>

#define N_INPUTS @INPUTS@
#define N_OUTPUTS @OUTPUTS@
#define N_STATES @STATES@
#define MOST_ROWS @ROWS@
#define LONGEST_PERIOD @LONGEST@
#define SHORTEST_PERIOD @SHORTEST@
/* Largest tick and largest number of an update or of a sequence: integers have 32 bits. */
#define LARGEST_NUMBER (INT32_MAX - 0x10000)

/* What the control PLC has latched at an updating instant, in physical units. */
typedef struct {
    int32_t update;
    int32_t tick;
    int32_t playing; /* the number of the sequence being played, 0 is none */
    float load;
    float u_before[N_INPUTS]; /* inputs until this tick, and from it on */
    float u[N_INPUTS];
    float y[N_OUTPUTS]; /* not a number where a measurement is bad */
    float x[N_STATES];  /* simulated states, which the Kalman filter does not read */
} Update;

typedef struct {
    int32_t update;
    int32_t next_update_tick;
    float load_step; /* a load that moves by more ends the period; 0 is never */
    float shortage;
    int32_t suspects;   /* readings that are not used: bit i is output i */
    int32_t iterations; /* of the solver: what fits into the period on the reference PLC */
} Plan;

typedef struct {
    int32_t number;
    int32_t update;
    int32_t first_tick;
    int32_t length; /* 0 where there is no answer: send the header alone, which is rejected (verdict 13) */
    int32_t tau_u;
    float rows[MOST_ROWS][N_INPUTS]; /* a row for each tick */
} Sequence;

/* What was done with the last update; costs are those of the augmented cost function. */
typedef struct {
    int32_t update, tick, tau_u, q, iterations;
    float effective, hot_start, delivered, deviation, constraints, violation;
    float efficiency, mismatch, contraction, gamma, load_mismatch;
} Report;

/* Begin a session at the operating point, with a fixed updating period in ticks or, for 0, an adaptive one.
 * False, and nothing happens, if there is no such period. */
bool optimizer_restart(int32_t fixed_ticks);

/* Take an update and decide the updating period. False, and nothing happens, before the first restart and for numbers
 * below 0 or above LARGEST_NUMBER. */
bool optimizer_plan(const Update *update, Plan *plan);

/* Compute the sequence that follows the last plan. False, and nothing happens, if there is none. */
bool optimizer_solve(Sequence *sequence);

/* Note how the answer came: whether the plan or the sequence was too late for the control PLC. */
void optimizer_answered(bool late);

/* What was done with the update of the last sequence. */
void optimizer_report(Report *report);

#endif
