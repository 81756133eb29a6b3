@GENERATED@
#include <string.h>

#include "constants.h"
#include "optimizer.h"

static OptimizerState state;
static Constants session; /* the constants, with the period of the session */
static bool begun = false;

static bool in_range(int32_t number) { return number >= 0 && number <= LARGEST_NUMBER; }

bool optimizer_restart(int32_t fixed_ticks) {
    if (fixed_ticks != 0 && (fixed_ticks < SHORTEST_PERIOD || fixed_ticks > LONGEST_PERIOD)) {
        return false;
    }
    session = constants;
    session.fixed_ticks = fixed_ticks;
    memset(&state, 0, sizeof state);
    begin_session(&session, &state);
    begun = true;
    return true;
}

bool optimizer_plan(const Update *update, Plan *plan) {
    if (!begun || !in_range(update->update) || !in_range(update->tick) || !in_range(update->playing)) {
        return false;
    }
    const Latched latched = {
        .update = update->update, .tick = update->tick, .playing = update->playing, .load = update->load,
        .u_before = update->u_before, .u = update->u, .y = update->y, .x = update->x, .ahead = update->x};
    plan->load_step =
        take_update(&session, &rules[session.fixed_ticks], &starts[session.fixed_ticks], &state, &latched);
    plan->update = update->update;
    plan->next_update_tick = update->tick + state.numbers[0].ticks;
    plan->shortage = state.numbers[0].shortage;
    plan->suspects = state.numbers[0].suspects;
    plan->iterations = state.numbers[0].iterations;
    return true;
}

bool optimizer_solve(Sequence *sequence) {
    if (!begun || !state.numbers[0].planned) {
        return false;
    }
    solve(&session, &method, &state);
    const DeliveryNumbers *sent = &state.sent.numbers[0];
    sequence->number = sent->number;
    sequence->update = state.numbers[0].update;
    sequence->first_tick = sent->first_tick;
    sequence->length = sent->length;
    sequence->tau_u = state.numbers[0].ticks;
    memcpy(sequence->rows, state.sent.rows, sizeof sequence->rows);
    return true;
}

void optimizer_answered(bool late) { note_answer(&state, late); }

void optimizer_report(Report *report) {
    const OptimizerStateNumbers *now = &state.numbers[0];
    const DeliveryNumbers *sent = &state.sent.numbers[0];
    report->update = now->update;
    report->tick = now->tick;
    report->tau_u = now->ticks;
    report->q = now->q;
    report->iterations = sent->iterations;
    report->effective = now->effective;
    report->hot_start = sent->hot_start;
    report->delivered = sent->delivered;
    report->deviation = sent->j_dev;
    report->constraints = sent->j_cst;
    report->violation = sent->violation;
    report->efficiency = now->efficiency;
    report->mismatch = now->mismatch;
    report->contraction = now->contraction;
    report->gamma = now->gamma_;
    report->load_mismatch = state.belief.numbers[0].mismatch;
}
