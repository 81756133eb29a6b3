@GENERATED@
/* The registers that an optimiser shows, on a server of its own: identity, session, time base, link, rule, the last
 * updates, configuration. There is no journal, no prediction and no model deviation: those blocks do not change. */
#ifndef DIAGNOSTICS_H
#define DIAGNOSTICS_H

#include "../optimizer.h"

/* Serve on 127.0.0.1, in a thread; with the parent, end when standard input is closed. */
bool diagnostics_serve(int port, bool with_parent);

/* The fixed updating period in ticks, 0 for adaptive, that was asked for a session; else `usual`. */
int32_t diagnostics_period(uint32_t session, int32_t usual);

/* Seconds of plant time in one of real time; 0 in lock-step. */
float diagnostics_factor(void);

void diagnostics_session(uint32_t session, int32_t fixed_ticks);
void diagnostics_link(bool up, uint32_t holder);
void diagnostics_update(const Report *report, int verdict);

#endif
