// Order of queries along a Morton curve, so that consecutive queries visit the same part of the tree.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace pcbench::mesh {

inline uint32_t spread_bits(uint32_t value) {  // moves ten bits to every third position
    value = (value | value << 16) & 0x030000FFu;
    value = (value | value << 8) & 0x0300F00Fu;
    value = (value | value << 4) & 0x030C30C3u;
    return (value | value << 2) & 0x09249249u;
}

// Indices of the points along a Morton curve: consecutive points are close in space.
inline std::vector<uint32_t> morton_order(const double* points, size_t count) {
    double low[3], high[3];
    for (int axis = 0; axis < 3; ++axis) low[axis] = HUGE_VAL, high[axis] = -HUGE_VAL;
    for (size_t i = 0; i < count; ++i)
        for (int axis = 0; axis < 3; ++axis) {
            low[axis] = std::min(low[axis], points[3 * i + axis]);
            high[axis] = std::max(high[axis], points[3 * i + axis]);
        }
    double widest = 0;
    for (int axis = 0; axis < 3; ++axis) widest = std::max(widest, high[axis] - low[axis]);
    const double scale = widest > 0 ? 1023.0 / widest : 0.0;
    std::vector<uint64_t> keys(count), other(count);
    for (size_t i = 0; i < count; ++i) {
        uint32_t code = 0;
        for (int axis = 0; axis < 3; ++axis)
            code |= spread_bits(static_cast<uint32_t>((points[3 * i + axis] - low[axis]) * scale)) << axis;
        keys[i] = static_cast<uint64_t>(code) << 32 | i;
    }
    for (int shift = 32; shift < 62; shift += 10) {  // radix sort, ten bits per pass
        size_t starts[1025] = {};
        for (uint64_t key : keys) ++starts[(key >> shift & 1023) + 1];
        for (int b = 0; b < 1024; ++b) starts[b + 1] += starts[b];
        for (uint64_t key : keys) other[starts[key >> shift & 1023]++] = key;
        keys.swap(other);
    }
    return std::vector<uint32_t>(keys.begin(), keys.end());
}

}  // namespace pcbench::mesh
