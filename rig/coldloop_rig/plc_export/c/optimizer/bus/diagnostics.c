@GENERATED@
#include <modbus/modbus.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/select.h>
#include <unistd.h>

#include "diagnostics.h"
#include "registers.h"
#include "words.h"

enum { WAITING = 2, SEARCHING = 0, RUNNING = 1, READ = 3, WRITE = 16 };

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER; /* of the registers */
static modbus_mapping_t *shown;
static modbus_t *server;
static int listener;
static bool ends_with_parent;
static uint32_t session;
static uint32_t breaks;
static bool was_up = false;

/* -- what is shown ------------------------------------------------------------------------------------------------ */

static void put_block(int address, const char *letters, uint16_t *words, int count) {
    order(letters, words, OPTIMIZER_LOW_FIRST);
    memcpy(shown->tab_registers + address, words, (size_t)count * sizeof *words);
}

static void get_block(int address, const char *letters, uint16_t *words, int count) {
    memcpy(words, shown->tab_registers + address, (size_t)count * sizeof *words);
    order(letters, words, OPTIMIZER_LOW_FIRST);
}

static void put_identity(uint32_t tick, uint32_t updates) {
    uint16_t words[OPTIMIZER_IDENTITY_WORDS];
    get_block(OPTIMIZER_IDENTITY, OPTIMIZER_IDENTITY_LETTERS, words, OPTIMIZER_IDENTITY_WORDS);
    uint16_t *at = put_u16(words + 5, session != 0 ? RUNNING : 0);
    put_u16(put_u32(put_u32(at + 2, session), tick), updates);
    put_block(OPTIMIZER_IDENTITY, OPTIMIZER_IDENTITY_LETTERS, words, OPTIMIZER_IDENTITY_WORDS);
}

int32_t diagnostics_period(uint32_t of_session, int32_t usual) {
    uint16_t words[SESSION_WORDS];
    pthread_mutex_lock(&lock);
    get_block(SESSION, SESSION_LETTERS, words, SESSION_WORDS);
    pthread_mutex_unlock(&lock);
    return get_u32(words) == of_session ? (int32_t)words[5] : usual;
}

float diagnostics_factor(void) {
    uint16_t words[PACE_WORDS];
    pthread_mutex_lock(&lock);
    get_block(PACE, PACE_LETTERS, words, PACE_WORDS);
    pthread_mutex_unlock(&lock);
    return words[2] != 0 ? get_f32(words + 3) : 0.0F;
}

void diagnostics_session(uint32_t number, int32_t fixed_ticks) {
    uint16_t asked[SESSION_WORDS], words[UPDATING_RULE_WORDS], pace[PACE_WORDS] = {0};
    pthread_mutex_lock(&lock);
    session = number;
    memset(shown->tab_registers + HISTORY, 0, HISTORY_ROWS * HISTORY_WORDS * sizeof(uint16_t));
    get_block(SESSION, SESSION_LETTERS, asked, SESSION_WORDS);
    put_u32(pace, number);
    put_f32(pace + 3, 1.0F);
    if (get_u32(asked) == number) {
        memcpy(pace + 2, asked + 2, 3 * sizeof *pace);
    }
    put_block(PACE, PACE_LETTERS, pace, PACE_WORDS);
    get_block(UPDATING_RULE, UPDATING_RULE_LETTERS, words, UPDATING_RULE_WORDS);
    for (int i = 0; i < RULE_NUMBERS; i += 1) {
        words[i] = rule_status[fixed_ticks][i];
    }
    put_block(UPDATING_RULE, UPDATING_RULE_LETTERS, words, UPDATING_RULE_WORDS);
    put_identity(0, 0);
    pthread_mutex_unlock(&lock);
}

void diagnostics_link(bool up, uint32_t holder) {
    uint16_t words[CONTROL_LINK_WORDS] = {0};
    pthread_mutex_lock(&lock);
    breaks += was_up && !up ? 1U : 0U;
    was_up = up;
    put_u32(put_u32(put_u16(words, up ? WAITING : SEARCHING), holder), breaks);
    put_block(CONTROL_LINK, CONTROL_LINK_LETTERS, words, CONTROL_LINK_WORDS);
    pthread_mutex_unlock(&lock);
}

void diagnostics_update(const Report *r, int verdict) {
    uint16_t words[HISTORY_WORDS];
    const float values[] = {r->effective,  r->hot_start, r->delivered,   r->deviation, r->constraints,  r->violation,
                            r->efficiency, r->mismatch,  r->contraction, r->gamma,     r->load_mismatch};
    uint16_t *at = put_u16(put_u32(put_u32(words, (uint32_t)r->update), (uint32_t)r->tick), (uint32_t)r->tau_u);
    at = put_u16(put_u16(put_u16(at, (uint32_t)r->q), (uint32_t)r->iterations), (uint32_t)verdict);
    for (size_t i = 0; i < sizeof values / sizeof *values; i += 1) {
        at = put_f32(at, values[i]);
    }
    pthread_mutex_lock(&lock);
    put_block(HISTORY + (r->update % HISTORY_ROWS) * HISTORY_WORDS, HISTORY_LETTERS, words, HISTORY_WORDS);
    put_identity((uint32_t)r->tick, (uint32_t)r->update + 1U);
    pthread_mutex_unlock(&lock);
}

/* -- the server --------------------------------------------------------------------------------------------------- */

/* Answer a request. Written are the settings of the next session and the time base alone. */
static void answer(const uint8_t *request, int length) {
    const int head = modbus_get_header_length(server);
    const int function = request[head], address = (request[head + 1] << 8) | request[head + 2];
    const int count = (request[head + 3] << 8) | request[head + 4];
    const bool to_session = address == SESSION && count == SESSION_WORDS;
    const bool to_pace = address == PACE && count == PACE_WORDS;
    if (function != READ && function != WRITE) {
        modbus_reply_exception(server, request, MODBUS_EXCEPTION_ILLEGAL_FUNCTION);
    } else if (function == WRITE && !to_session && !to_pace) {
        modbus_reply_exception(server, request, MODBUS_EXCEPTION_ILLEGAL_DATA_ADDRESS);
    } else {
        const int period = to_session ? (request[length - 2] << 8) | request[length - 1] : 0;
        if (function == WRITE && period != 0 && (period < SHORTEST_PERIOD || period > LONGEST_PERIOD)) {
            modbus_reply_exception(server, request, MODBUS_EXCEPTION_ILLEGAL_DATA_VALUE);
            return;
        }
        pthread_mutex_lock(&lock);
        modbus_reply(server, request, length, shown);
        if (function == WRITE && to_pace) { /* session 0 is the present one */
            uint16_t words[2];
            put_u32(words, session);
            put_block(PACE, "I", words, 2);
        }
        pthread_mutex_unlock(&lock);
    }
}

static void *serve(void *unused) {
    (void)unused;
    fd_set all;
    int highest = listener;
    FD_ZERO(&all);
    FD_SET(listener, &all);
    if (ends_with_parent) {
        FD_SET(STDIN_FILENO, &all);
    }
    for (;;) {
        fd_set ready = all;
        if (select(highest + 1, &ready, NULL, NULL, NULL) < 0) {
            continue;
        }
        for (int fd = 0; fd <= highest; fd += 1) {
            if (!FD_ISSET(fd, &ready)) {
                continue;
            }
            if (fd == STDIN_FILENO && ends_with_parent) {
                char none[16];
                if (read(fd, none, sizeof none) <= 0) {
                    _exit(0);
                }
            } else if (fd == listener) {
                const int client = modbus_tcp_accept(server, &listener);
                if (client >= FD_SETSIZE) {
                    close(client);
                } else if (client >= 0) {
                    FD_SET(client, &all);
                    highest = client > highest ? client : highest;
                }
            } else {
                uint8_t request[MODBUS_TCP_MAX_ADU_LENGTH];
                modbus_set_socket(server, fd);
                const int length = modbus_receive(server, request);
                if (length > 0) {
                    answer(request, length);
                } else if (length < 0) {
                    close(fd);
                    FD_CLR(fd, &all);
                }
            }
        }
    }
    return NULL;
}

bool diagnostics_serve(int port, bool with_parent) {
    pthread_t thread;
    ends_with_parent = with_parent;
    shown = modbus_mapping_new(0, 0, 0x10000, 0);
    server = modbus_new_tcp("127.0.0.1", port);
    if (shown == NULL || server == NULL) {
        return false;
    }
    for (size_t i = 0; i < sizeof image / sizeof *image; i += 1) {
        shown->tab_registers[image[i][0]] = image[i][1];
    }
    listener = modbus_tcp_listen(server, 8);
    return listener >= 0 && pthread_create(&thread, NULL, serve, NULL) == 0;
}
