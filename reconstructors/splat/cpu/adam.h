// Adam (Kingma and Ba 2015) on the rows of an array that have a gradient; other rows keep their parameters and moments.
#pragma once
#include "rows.h"

namespace PCB_SPACE {

// Row i of `gradient` belongs to row rows[i] of the other arrays, for i in begin .. end. `rates`, one per column,
// include both bias corrections: rate sqrt(1 - beta2^t) / (1 - beta1^t).
inline void adam(float* parameters, float* first, float* second, const float* gradient, const int64_t* rows,
                 int64_t begin, int64_t end, int columns, const float* rates, float beta1, float beta2, float epsilon) {
    const Floats b1 = Floats(beta1), b2 = Floats(beta2), c1 = Floats(1.0f - beta1), c2 = Floats(1.0f - beta2);
    const Floats small = Floats(epsilon);
    for (int64_t i = begin; i < end; ++i) {
        const size_t to = static_cast<size_t>(columns) * static_cast<size_t>(rows[i]);
        const size_t from = static_cast<size_t>(columns) * static_cast<size_t>(i);
        for (int at = 0; at < columns; at += kLanes) {
            const int count = columns - at < kLanes ? columns - at : kLanes;
            float *p = parameters + to + at, *m = first + to + at, *v = second + to + at;
            const Floats g = load_first(gradient + from + at, count);
            const Floats mean = fused(b1, load_first(m, count), c1 * g);
            const Floats square = fused(b2, load_first(v, count), c2 * g * g);
            store_first(m, count, mean), store_first(v, count, square);
            store_first(p, count,
                        fused(-load_first(rates + at, count), mean / (root(square) + small), load_first(p, count)));
        }
    }
}

}  // namespace PCB_SPACE
