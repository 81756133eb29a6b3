@GENERATED@
/* The exported optimiser in the place of Coldloop's: a client of the control PLC, and a server of its diagnostics.
 *
 * In real time an answer is sent when the reference PLC would have it. */
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "control_plc.h"
#include "diagnostics.h"
#include "registers.h"

static const char *host = "127.0.0.1";
static int control_port = CONTROL_PORT, own_port = OPTIMIZER_PORT;
static bool with_parent = false;

static void pause_ms(int64_t ms) {
    const struct timespec time = {(time_t)(ms / 1000), (long)(ms % 1000) * 1000000L};
    nanosleep(&time, NULL);
}

static int64_t now_ms(void) {
    struct timespec time;
    clock_gettime(CLOCK_MONOTONIC, &time);
    return (int64_t)time.tv_sec * 1000 + time.tv_nsec / 1000000;
}

static void fail(const char *why) {
    fprintf(stderr, "optimizer_plc: %s\n", why);
    exit(2);
}

/* In real time, wait until the reference PLC would have the answer to an update that came at `arrived`, ms, and give
 * signs of life; `cut_off` where a load step or another session ends the computation before. */
static bool wait_for_plc(
    ControlPlc *plc, uint32_t session, const Update *update, const Plan *plan, int64_t arrived, bool *cut_off) {
    const double factor = (double)diagnostics_factor();
    const bool interruptible = plan->load_step > 0;
    *cut_off = false;
    if (factor <= 0) {
        return true;
    }
    const double seconds = (PREPARATION_S + plan->iterations * ITERATION_S) / factor;
    const double spacing = 1000 * (interruptible ? LOOK_OUT_S : HEARTBEAT_S) / factor;
    const int64_t look = spacing < 1 ? 1 : spacing > 1000 ? 1000 : (int64_t)spacing;
    const int64_t ready = arrived + (int64_t)(1000 * seconds);
    for (int64_t left = ready - now_ms(); left > 0; left = ready - now_ms()) {
        pause_ms(left < look ? left : look);
        if (interruptible || left > look) {
            uint32_t newest_session, newest;
            if (!control_newest(plc, &newest_session, &newest)) {
                return false;
            }
            if (newest_session != session || (interruptible && newest > (uint32_t)update->update)) {
                *cut_off = true;
                return true;
            }
        }
    }
    return true;
}

/* Plan, solve, send; find out which update is to be asked for next. False where the link is lost. */
static bool answer(ControlPlc *plc, uint32_t session, const Update *update, int64_t arrived, bool *fresh) {
    static Sequence sequence;
    Plan plan;
    Report report;
    bool cut_off;
    int verdict = 0;
    if (!optimizer_plan(update, &plan)) {
        fail("a tick or a number is beyond what its 32 bits hold: begin another session");
    }
    if (!control_plan(plc, &plan) || !optimizer_solve(&sequence) ||
        !wait_for_plc(plc, session, update, &plan, arrived, &cut_off) ||
        (!cut_off && !control_send(plc, &sequence, &verdict))) {
        return false;
    }
    optimizer_report(&report);
    diagnostics_update(&report, verdict);
    *fresh = verdict == LATE;
    if (verdict == WRONG_UPDATE) { /* the plan was too late, unless a load step has led to another update */
        uint32_t newest_session, newest;
        if (!control_newest(plc, &newest_session, &newest)) {
            return false;
        }
        *fresh = newest_session == session && newest <= (uint32_t)update->update;
    }
    if (*fresh || verdict == ACCEPTED) {
        optimizer_answered(*fresh);
    }
    return true;
}

/* Answer one update after the other until the link is lost; `current` is the session that the optimiser is in. */
static void serve_updates(ControlPlc *plc, uint32_t *current) {
    uint32_t session = 0, number = 0; /* a fresh update, whatever the session */
    for (;;) {
        Update update;
        uint32_t got;
        const int64_t asked = now_ms();
        if (!control_await(plc, session, number, &got, &update)) {
            return;
        }
        const int64_t arrived = now_ms();
        const bool old = got == session && (uint32_t)update.update < number;
        if (got == 0 || old) {
            if (got == 0 || (uint32_t)update.update + 1U < number) { /* another session, which counts from 0 */
                session = number = 0;
            }
            if (arrived - asked < 20) {
                pause_ms(20);
            }
            continue;
        }
        if (got != *current) {
            const int32_t period = diagnostics_period(got, USUAL_PERIOD);
            optimizer_restart(period);
            diagnostics_session(got, period);
            *current = got;
        }
        bool fresh;
        if (!answer(plc, got, &update, arrived, &fresh)) {
            return;
        }
        session = fresh ? 0 : got;
        number = fresh ? 0 : (uint32_t)update.update + 1U;
    }
}

static void read_options(int count, char **options) {
    for (int i = 1; i < count; i += 1) {
        if (strcmp(options[i], "--with-parent") == 0) {
            with_parent = true;
        } else if (strcmp(options[i], "--host") == 0 && i + 1 < count) {
            host = options[i += 1];
        } else if (strcmp(options[i], "--port") == 0 && i + 1 < count) {
            control_port = atoi(options[i += 1]);
        } else if (strcmp(options[i], "--listen") == 0 && i + 1 < count) {
            own_port = atoi(options[i += 1]);
        } else {
            fail("usage: [--host ADDRESS] [--port PORT of the control PLC] [--listen PORT] [--with-parent]");
        }
    }
}

static uint32_t random_holder(void) {
    uint32_t holder = 0;
    const int file = open("/dev/urandom", O_RDONLY);
    if (file < 0 || read(file, &holder, sizeof holder) != (ssize_t)sizeof holder) {
        fail("no random number: /dev/urandom cannot be read");
    }
    close(file);
    return holder != 0 ? holder : 1;
}

int main(int count, char **options) {
    read_options(count, options);
    ControlPlc plc = {.bus = NULL, .holder = random_holder()};
    char told[sizeof plc.problem] = "";
    uint32_t current = 0;
    if (!diagnostics_serve(own_port, with_parent)) {
        fail("its port cannot be listened on: it is in use, or not allowed");
    }
    printf("{\"event\": \"serving\", \"service\": \"optimizer_plc\", \"port\": %d}\n", own_port);
    fflush(stdout);
    for (;;) {
        if (control_connect(&plc, host, control_port)) {
            told[0] = '\0';
            diagnostics_link(true, plc.holder);
            serve_updates(&plc, &current);
        }
        diagnostics_link(false, plc.holder);
        control_close(&plc);
        if (strcmp(told, plc.problem) != 0) {
            fprintf(stderr, "optimizer_plc: control PLC at %s:%d: %s; tried again\n", host, control_port, plc.problem);
            memcpy(told, plc.problem, sizeof told);
        }
        pause_ms(200);
    }
}
