@GENERATED@
#include <string.h>

#include "words.h"

uint16_t *put_u16(uint16_t *at, uint32_t value) {
    at[0] = (uint16_t)(value & 0xFFFFU);
    return at + 1;
}

uint16_t *put_u32(uint16_t *at, uint32_t value) { return put_u16(put_u16(at, value >> 16), value); }

uint16_t *put_f32(uint16_t *at, float value) {
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    return put_u32(at, bits);
}

uint32_t get_u32(const uint16_t *at) { return ((uint32_t)at[0] << 16) | at[1]; }

float get_f32(const uint16_t *at) {
    const uint32_t bits = get_u32(at);
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

void order(const char *letters, uint16_t *words, bool low_first) {
    for (; low_first && *letters != '\0'; letters += 1) {
        if (*letters != 'H') {
            const uint16_t high = words[0];
            words[0] = words[1];
            words[1] = high;
            words += 1;
        }
        words += 1;
    }
}

uint32_t crc_of(uint32_t crc, const uint16_t *words, int count) {
    crc = ~crc;
    for (int byte = 0; byte < 2 * count; byte += 1) {
        crc ^= byte % 2 == 0 ? (uint32_t)words[byte / 2] >> 8 : words[byte / 2] & 0xFFU;
        for (int bit = 0; bit < 8; bit += 1) {
            crc = (crc & 1U) != 0 ? (crc >> 1) ^ UINT32_C(0xEDB88320) : crc >> 1;
        }
    }
    return ~crc;
}

static uint32_t seal_of(const uint16_t *words, int count) {
    const uint32_t crc = crc_of(0, words, count);
    return crc != 0 ? crc : 1;
}

void seal(uint16_t *words, int count) { put_u32(words + count, seal_of(words, count)); }

bool is_sealed(const uint16_t *words, int count) { return get_u32(words + count) == seal_of(words, count); }
