@GENERATED@
/* The control PLC, by its registers (docs/your-optimiser.md). Functions return false where the link is lost, and say why
 * by `problem`. */
#ifndef CONTROL_PLC_H
#define CONTROL_PLC_H

#include <modbus/modbus.h>

#include "../optimizer.h"

enum { ACCEPTED = 1, LATE = 2, WRONG_UPDATE = 3 };

typedef struct {
    modbus_t *bus;
    bool low_first;
    uint32_t holder; /* a number that this optimiser has given itself */
    uint16_t beats;
    char problem[160];
} ControlPlc;

/* Connect, find out the word order, check the model and take the lease. */
bool control_connect(ControlPlc *plc, const char *host, int port);
void control_close(ControlPlc *plc);

/* Wait up to 1 s for an update; its session is 0 where there is none. Session 0 asks for a fresh one. */
bool control_await(ControlPlc *plc, uint32_t session, uint32_t number, uint32_t *got_session, Update *update);
bool control_plan(ControlPlc *plc, const Plan *plan);
bool control_send(ControlPlc *plc, const Sequence *sequence, int *verdict);

/* Give a sign of life; find out which update is the newest. */
bool control_newest(ControlPlc *plc, uint32_t *session, uint32_t *number);

#endif
