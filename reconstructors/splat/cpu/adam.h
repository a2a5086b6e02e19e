// Adam (Kingma and Ba 2015) on the rows of an array that were seen: the others keep their parameters and their moments.
#pragma once
#include "rows.h"

namespace PCB_SPACE {

// Row i of `gradient` belongs to row rows[i] of the others, for i in begin .. end. `rate` already holds the corrections
// of both biases: rate sqrt(1 - beta2^t) / (1 - beta1^t).
inline void adam(float* parameters, float* first, float* second, const float* gradient, const int64_t* rows,
                 int64_t begin, int64_t end, int columns, float rate, float beta1, float beta2, float epsilon) {
    const Floats b1 = Floats(beta1), b2 = Floats(beta2), c1 = Floats(1.0f - beta1), c2 = Floats(1.0f - beta2);
    const Floats step = Floats(-rate), small = Floats(epsilon);
    const auto move = [&](float* p, float* m, float* v, const float* g) {
        const Floats by = load(g);
        const Floats mean = fused(b1, load(m), c1 * by), square = fused(b2, load(v), c2 * by * by);
        store(m, mean), store(v, square);
        store(p, fused(step, mean / (root(square) + small), load(p)));
    };
    for (int64_t i = begin; i < end; ++i) {
        const size_t to = static_cast<size_t>(columns) * static_cast<size_t>(rows[i]);
        const size_t from = static_cast<size_t>(columns) * static_cast<size_t>(i);
        int at = 0;
        for (; at + kLanes <= columns; at += kLanes)
            move(parameters + to + at, first + to + at, second + to + at, gradient + from + at);
        if (at == columns) continue;
        float p[kLanes] = {}, m[kLanes] = {}, v[kLanes] = {}, g[kLanes] = {};
        const int rest = columns - at;
        for (int k = 0; k < rest; ++k) {
            p[k] = parameters[to + at + k], m[k] = first[to + at + k], v[k] = second[to + at + k];
            g[k] = gradient[from + at + k];
        }
        move(p, m, v, g);
        for (int k = 0; k < rest; ++k)
            parameters[to + at + k] = p[k], first[to + at + k] = m[k], second[to + at + k] = v[k];
    }
}

}  // namespace PCB_SPACE
