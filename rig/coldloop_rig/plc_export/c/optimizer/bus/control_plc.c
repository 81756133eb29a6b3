@GENERATED@
#include <errno.h>
#include <stdio.h>
#include <string.h>

#include "control_plc.h"
#include "registers.h"
#include "words.h"

enum { ROWS_WITH_HEADER = (121 - SEQUENCE_HEADER_WORDS) / SEQUENCE_ROW_WORDS, MOST_ROWS_AT_ONCE = 123 / SEQUENCE_ROW_WORDS };

static bool failed(ControlPlc *plc, const char *why) {
    snprintf(plc->problem, sizeof plc->problem, "%s", why);
    return false;
}

static bool lost(ControlPlc *plc) { return failed(plc, modbus_strerror(errno)); }

static bool write_block(ControlPlc *plc, int address, const char *letters, uint16_t *words, int count) {
    order(letters, words, plc->low_first);
    return modbus_write_registers(plc->bus, address, count, words) == count || lost(plc);
}

static bool exchange(
    ControlPlc *plc, int address, const char *letters, uint16_t *words, int count, int read, const char *read_letters,
    uint16_t *got, int read_count) {
    order(letters, words, plc->low_first);
    if (modbus_write_and_read_registers(plc->bus, address, count, words, read, read_count, got) != read_count) {
        return lost(plc);
    }
    order(read_letters, got, plc->low_first);
    return true;
}

static void heartbeat(ControlPlc *plc, uint16_t *words) {
    plc->beats = (uint16_t)(plc->beats + 1U);
    put_u32(put_u32(put_u16(words, plc->beats), MODEL_DIGEST), plc->holder);
    seal(words, HEARTBEAT_WORDS - 2);
}

bool control_connect(ControlPlc *plc, const char *host, int port) {
    uint16_t words[IDENTITY_WORDS];
    plc->bus = modbus_new_tcp(host, port);
    if (plc->bus == NULL || modbus_connect(plc->bus) != 0) {
        return lost(plc);
    }
    modbus_set_response_timeout(plc->bus, 5, 0);
    if (modbus_read_registers(plc->bus, IDENTITY, IDENTITY_WORDS, words) != IDENTITY_WORDS) {
        return lost(plc);
    }
    uint16_t magic[2];
    put_f32(magic, MAGIC);
    plc->low_first = words[0] == magic[1] && words[1] == magic[0];
    order(IDENTITY_LETTERS, words, plc->low_first);
    if (memcmp(words, magic, sizeof magic) != 0) {
        return failed(plc, "the first value is not 123.456: not a control PLC, or another address base");
    }
    if (get_u32(words + IDENTITY_MODEL) != MODEL_DIGEST) {
        return failed(plc, "it runs another model: export the optimiser again, with the model file that it has");
    }
    uint16_t beat[HEARTBEAT_WORDS];
    heartbeat(plc, beat);
    return write_block(plc, HEARTBEAT, HEARTBEAT_LETTERS, beat, HEARTBEAT_WORDS);
}

void control_close(ControlPlc *plc) {
    if (plc->bus != NULL) {
        modbus_close(plc->bus);
        modbus_free(plc->bus);
        plc->bus = NULL;
    }
}

bool control_await(ControlPlc *plc, uint32_t session, uint32_t number, uint32_t *got_session, Update *update) {
    uint16_t asked[AWAIT_UPDATE_WORDS], words[UPDATE_WORDS];
    put_u32(put_u32(asked, session), number);
    seal(asked, AWAIT_UPDATE_WORDS - 2);
    if (!exchange(plc, AWAIT_UPDATE, AWAIT_UPDATE_LETTERS, asked, AWAIT_UPDATE_WORDS, UPDATE, UPDATE_LETTERS, words,
                  UPDATE_WORDS)) {
        return false;
    }
    if (!is_sealed(words, UPDATE_WORDS - 2)) { /* it is latched still: asking to wait again could give it up */
        if (modbus_read_registers(plc->bus, UPDATE, UPDATE_WORDS, words) != UPDATE_WORDS) {
            return lost(plc);
        }
        order(UPDATE_LETTERS, words, plc->low_first);
        if (!is_sealed(words, UPDATE_WORDS - 2)) {
            return failed(plc, "an update has arrived damaged");
        }
    }
    *got_session = get_u32(words);
    update->update = (int32_t)get_u32(words + 2);
    update->tick = (int32_t)get_u32(words + 4);
    update->playing = (int32_t)get_u32(words + 6);
    update->load = get_f32(words + 8);
    const uint16_t *at = words + 10;
    float *const arrays[] = {update->u_before, update->u, update->y, update->x};
    const int lengths[] = {N_INPUTS, N_INPUTS, N_OUTPUTS, N_STATES};
    for (int array = 0; array < 4; array += 1) {
        for (int i = 0; i < lengths[array]; i += 1, at += 2) {
            arrays[array][i] = get_f32(at);
        }
    }
    return true;
}

bool control_plan(ControlPlc *plc, const Plan *plan) {
    uint16_t words[PLAN_WORDS];
    uint16_t *at = put_u32(put_u32(words, (uint32_t)plan->update), (uint32_t)plan->next_update_tick);
    put_u32(put_f32(put_f32(at, plan->load_step), plan->shortage), (uint32_t)plan->suspects);
    seal(words, PLAN_WORDS - 2);
    return write_block(plc, PLAN, PLAN_LETTERS, words, PLAN_WORDS);
}

/* Put rows together as they are sent; return the CRC-32 up to them. */
static uint32_t rows_of(const Sequence *sequence, int first, int count, uint16_t *words, uint32_t crc) {
    uint16_t *at = words;
    for (int row = first; row < first + count; row += 1) {
        for (int i = 0; i < N_INPUTS; i += 1) {
            at = put_f32(at, sequence->rows[row][i]);
        }
    }
    return crc_of(crc, words, count * SEQUENCE_ROW_WORDS);
}

static void order_rows(uint16_t *words, int count, bool low_first) {
    for (int row = 0; row < count; row += 1) {
        order(SEQUENCE_ROW_LETTERS, words + row * SEQUENCE_ROW_WORDS, low_first);
    }
}

bool control_send(ControlPlc *plc, const Sequence *sequence, int *verdict) {
    uint16_t words[SEQUENCE_HEADER_WORDS + ROWS_WITH_HEADER * SEQUENCE_ROW_WORDS], rows[MOST_ROWS_AT_ONCE * SEQUENCE_ROW_WORDS];
    uint16_t *at = put_u32(put_u32(words, (uint32_t)sequence->number), (uint32_t)sequence->update);
    at = put_u16(put_u32(at, (uint32_t)sequence->first_tick), (uint32_t)sequence->length);
    at = put_u32(put_u16(at, (uint32_t)sequence->tau_u), MODEL_DIGEST);
    const int with_header = sequence->length < ROWS_WITH_HEADER ? sequence->length : ROWS_WITH_HEADER;
    uint32_t crc = crc_of(0, words, SEQUENCE_HEADER_WORDS - 2);
    crc = rows_of(sequence, 0, with_header, words + SEQUENCE_HEADER_WORDS, crc);
    for (int first = with_header; first < sequence->length; first += MOST_ROWS_AT_ONCE) {
        const int left = sequence->length - first, count = left < MOST_ROWS_AT_ONCE ? left : MOST_ROWS_AT_ONCE;
        crc = rows_of(sequence, first, count, rows, crc);
        order_rows(rows, count, plc->low_first);
        const int size = count * SEQUENCE_ROW_WORDS;
        if (modbus_write_registers(plc->bus, SEQUENCE + first * SEQUENCE_ROW_WORDS, size, rows) != size) {
            return lost(plc);
        }
    }
    put_u32(at, crc);
    order_rows(words + SEQUENCE_HEADER_WORDS, with_header, plc->low_first);
    uint16_t got[ACKNOWLEDGEMENT_WORDS];
    const int count = SEQUENCE_HEADER_WORDS + with_header * SEQUENCE_ROW_WORDS;
    if (!exchange(plc, SEQUENCE_HEADER, SEQUENCE_HEADER_LETTERS, words, count, ACKNOWLEDGEMENT, ACKNOWLEDGEMENT_LETTERS,
                  got, ACKNOWLEDGEMENT_WORDS)) {
        return false;
    }
    if (!is_sealed(got, ACKNOWLEDGEMENT_WORDS - 2) || get_u32(got) != (uint32_t)sequence->number) {
        return failed(plc, "the acknowledgement is damaged, or of another sequence: look for a second optimiser");
    }
    *verdict = got[2];
    return true;
}

bool control_newest(ControlPlc *plc, uint32_t *session, uint32_t *number) {
    uint16_t beat[HEARTBEAT_WORDS], words[LATCHED_UPDATE_WORDS];
    heartbeat(plc, beat);
    if (!exchange(plc, HEARTBEAT, HEARTBEAT_LETTERS, beat, HEARTBEAT_WORDS, LATCHED_UPDATE, LATCHED_UPDATE_LETTERS,
                  words, LATCHED_UPDATE_WORDS)) {
        return false;
    }
    *session = get_u32(words);
    *number = get_u32(words + 2);
    return true;
}
