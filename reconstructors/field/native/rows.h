// Loops over the rows of vertices: total variation and optimizer.
#pragma once

namespace PCB_SPACE {

constexpr float kDecay = 0.95f;       // of the mean square gradients
constexpr float kTiny = 1e-8f;        // added to their root
constexpr float kSmoothness = 1e-4f;  // square of the difference below which total variation becomes quadratic

// Anisotropic total variation: the sum over pairs of neighboring vertices of sqrt(difference^2 + kSmoothness).
inline void smooth(const Update& u, int64_t begin, int64_t end) {
    const int64_t stride[3] = {static_cast<int64_t>(u.size[1]) * u.size[2], u.size[2], 1};
    const Floats strength = load(u.smoothing);
    for (int64_t row = begin; row < end; ++row) {
        if (!u.touched[row]) continue;
        const int64_t vertex = u.vertices[row];
        const int at[3] = {static_cast<int>(vertex / stride[0]), static_cast<int>(vertex / stride[1] % u.size[1]),
                           static_cast<int>(vertex % u.size[2])};
        const Floats own = load(u.values + row * kChannels);
        Floats sum(0.0f);
        for (int side = 0; side < 6; ++side) {
            const int axis = side / 2, sign = side % 2 ? 1 : -1, next = at[axis] + sign;
            if (next < 0 || next >= u.size[axis]) continue;
            const int32_t other = u.links[vertex + sign * stride[axis]];
            if (other < 0) continue;
            const Floats difference = own - load(u.values + static_cast<size_t>(other) * kChannels);
            sum = sum + difference / root(difference * difference + Floats(kSmoothness));
        }
        float* to = u.gradients + row * kChannels;
        store(to, load(to) + strength * sum);
    }
}

inline void descend(const Update& u, int64_t begin, int64_t end) {
    const Floats rates = load(u.rates), zero(0.0f);
    for (int64_t row = begin; row < end; ++row) {
        if (!u.touched[row]) continue;
        float *values = u.values + row * kChannels, *moments = u.moments + row * kChannels;
        float* gradients = u.gradients + row * kChannels;
        const Floats gradient = load(gradients), square = gradient * gradient, moment = load(moments);
        // The first gradient of a row is its first mean.
        const Floats mean = select(zero < moment, Floats(kDecay) * moment + Floats(1.0f - kDecay) * square, square);
        store(moments, mean);
        store(values, load(values) - rates * (gradient / (root(mean) + Floats(kTiny))));
        store(gradients, zero);
        u.touched[row] = 0;
    }
}

}  // namespace PCB_SPACE
