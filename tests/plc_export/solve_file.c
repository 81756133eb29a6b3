/* Solves the problems of a file with an exported solver; words of 4 bytes, the lowest first, on any processor. */

#include <stdio.h>
#include <string.h>
#include "kernels.h"
#include "problem.h"

#define READ(array) (read_words(array, sizeof array / sizeof array[0]))
#define WRITE(array) (write_words(array, sizeof array / sizeof array[0]))

static int read_words(void *values, size_t count) {
    unsigned char bytes[4];
    for (size_t place = 0; place < count; place += 1) {
        if (fread(bytes, 1, 4, stdin) != 4) {
            return 0;
        }
        const uint32_t word = (uint32_t)bytes[0] | (uint32_t)bytes[1] << 8 | (uint32_t)bytes[2] << 16 | (uint32_t)bytes[3] << 24;
        memcpy((char *)values + 4 * place, &word, 4);
    }
    return 1;
}

static void write_words(const void *values, size_t count) {
    for (size_t place = 0; place < count; place += 1) {
        uint32_t word;
        memcpy(&word, (const char *)values + 4 * place, 4);
        for (int shift = 0; shift < 32; shift += 8) {
            putchar((int)(word >> shift & 0xffu));
        }
    }
}

int main(void) {
    static float phi[N_VARIABLES], gamma[N_ROWS], low[N_VARIABLES], high[N_VARIABLES], guess[N_VARIABLES];
    static float guessed[1], points[N_COUNTS * N_VARIABLES], costs[N_COUNTS];
    static int32_t iterations[N_COUNTS];
    while (READ(phi) && READ(gamma) && READ(low) && READ(high) && READ(guess)) {
        solve_problem(phi, gamma, low, high, guess, guessed, points, costs, iterations);
        WRITE(guessed);
        WRITE(points);
        WRITE(costs);
        WRITE(iterations);
    }
    return 0;
}
