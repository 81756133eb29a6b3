@GENERATED@
/* Values and registers. A block of values is put together with the high word first; `order` makes it what is sent. */
#ifndef WORDS_H
#define WORDS_H

#include <stdbool.h>
#include <stdint.h>

uint16_t *put_u16(uint16_t *at, uint32_t value);
uint16_t *put_u32(uint16_t *at, uint32_t value);
uint16_t *put_f32(uint16_t *at, float value);
uint32_t get_u32(const uint16_t *at);
float get_f32(const uint16_t *at);

/* Swap the words of the values that have two, where the low word is sent first; `letters` are as in Python's struct. */
void order(const char *letters, uint16_t *words, bool low_first);

/* CRC-32 of registers, high byte first, with the high word first. */
uint32_t crc_of(uint32_t crc, const uint16_t *words, int count);

/* Put the CRC-32 of a block behind it; 0 would be none, so it is 1 then. */
void seal(uint16_t *words, int count);
bool is_sealed(const uint16_t *words, int count);

#endif
