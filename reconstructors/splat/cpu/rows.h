// Conversion between row-major arrays and SIMD vectors of sixteen rows.
#pragma once

namespace PCB_SPACE {

inline Vec<Floats> vector_of(const float* rows) {
    return {load_strided(rows, 3), load_strided(rows + 1, 3), load_strided(rows + 2, 3)};
}

// Writes the lanes whose bit in `lanes` is set to consecutive rows.
inline void write_column(float* rows, int width, int column, unsigned lanes, Floats values) {
    float all[kLanes];
    store(all, values);
    for (int at = 0; lanes != 0; lanes &= lanes - 1, ++at) rows[at * width + column] = all[__builtin_ctz(lanes)];
}
inline void write_vector(float* rows, int width, int column, unsigned lanes, Vec<Floats> values) {
    write_column(rows, width, column, lanes, values.x);
    write_column(rows, width, column + 1, lanes, values.y);
    write_column(rows, width, column + 2, lanes, values.z);
}

// The sum of all lanes, added in the same order as in `sums`.
inline float sum(Floats values) {
    float all[kLanes];
    store(all, values);
    for (int half = kLanes / 2; half > 0; half /= 2)
        for (int i = 0; i < half; ++i) all[i] += all[i + half];
    return all[0];
}

}  // namespace PCB_SPACE
