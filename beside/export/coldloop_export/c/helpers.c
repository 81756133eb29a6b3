static inline @REAL@ min_real(@REAL@ one, @REAL@ other) {
    return other < one ? other : one;
}

static inline @REAL@ max_real(@REAL@ one, @REAL@ other) {
    return other > one ? other : one;
}

static inline int32_t min_int(int32_t one, int32_t other) {
    return other < one ? other : one;
}

static inline int32_t max_int(int32_t one, int32_t other) {
    return other > one ? other : one;
}

static inline int32_t floor_mod(int32_t one, int32_t other) {
    const int32_t rest = one % other;
    return rest < 0 ? rest + other : rest;
}

static inline int32_t floor_div(int32_t one, int32_t other) {
    return (one - floor_mod(one, other)) / other;
}
