// Lowest and highest coordinates of points.
#pragma once
#include <cmath>
#include <cstddef>
#include <cstdint>

namespace pcbench {

// Writes the corners of the box around the points, count >= 1. A coordinate that is NaN for any point is NaN in both.
inline void bounds(const double* points, size_t count, double* lower, double* upper) {
    constexpr size_t kValues = 12;  // of four points at once, which hides the latency of comparisons
    double low[kValues], high[kValues];
    int64_t has_nan[kValues] = {};
    for (size_t j = 0; j < kValues; ++j) low[j] = high[j] = points[j % 3];
    const auto include = [&](const double* values, size_t size) {
        for (size_t j = 0; j < size; ++j) {
            low[j] = values[j] < low[j] ? values[j] : low[j];
            high[j] = high[j] < values[j] ? values[j] : high[j];
            has_nan[j] |= -static_cast<int64_t>(values[j] != values[j]);
        }
    };
    size_t i = 0;
    for (; i + kValues <= 3 * count; i += kValues) include(points + i, kValues);
    include(points + i, 3 * count - i);
    for (size_t axis = 0; axis < 3; ++axis) {
        bool is_nan = false;
        for (size_t j = axis; j < kValues; j += 3) {
            low[axis] = low[j] < low[axis] ? low[j] : low[axis];
            high[axis] = high[axis] < high[j] ? high[j] : high[axis];
            is_nan = is_nan || has_nan[j] != 0;
        }
        lower[axis] = is_nan ? NAN : low[axis];
        upper[axis] = is_nan ? NAN : high[axis];
    }
}

}  // namespace pcbench
