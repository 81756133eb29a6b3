/* Values are read where they are, whatever the compiler knows of them: they are volatile. */
static uint32_t sum_of_byte(uint32_t sum, uint32_t byte) {
    sum ^= byte;
    for (int bit = 0; bit < 8; bit += 1) {
        sum = (sum & 1U) ? (sum >> 1) ^ UINT32_C(0xEDB88320) : sum >> 1;
    }
    return sum;
}

uint32_t sum_of_reals(uint32_t sum, const volatile @REAL@ *values, int32_t count) {
    sum = ~sum;
    for (int32_t i = 0; i < count; i += 1) {
        @BITS@ bits;
        const @REAL@ value = values[i];
        memcpy(&bits, &value, sizeof bits);
        for (int byte = @BYTES@ - 1; byte >= 0; byte -= 1) {
            sum = sum_of_byte(sum, (uint32_t)((bits >> (8 * byte)) & 0xFFU));
        }
    }
    return ~sum;
}

uint32_t sum_of_integers(uint32_t sum, const volatile int32_t *values, int32_t count) {
    sum = ~sum;
    for (int32_t i = 0; i < count; i += 1) {
        const uint32_t bits = (uint32_t)values[i];
        for (int byte = 3; byte >= 0; byte -= 1) {
            sum = sum_of_byte(sum, (bits >> (8 * byte)) & 0xFFU);
        }
    }
    return ~sum;
}
