// Rays through the field: forward, backward, and the sums of gradients at the vertices.
#pragma once

namespace PCB_SPACE {

static_assert(kLanes == kChannels, "a row is one vector");

constexpr float kLn2 = 0.693147181f;

// e^-x for x >= 0 with a relative error below 1e-6, the same bits everywhere: 2^n times a polynomial on [-1/2, 1/2].
inline float exp_minus(float x) {
    const float scaled = x < 87.0f ? x * -1.44269504f : -125.0f;
    const float whole = (scaled + 12582912.0f) - 12582912.0f;  // 1.5 * 2^23: rounds to the nearest integer
    const float rest = scaled - whole;
    float y = rest * 0.0013276472f + 0.0096755415f;
    y = y * rest + 0.0555071328f;
    y = y * rest + 0.240221197f;
    y = y * rest + 0.693146967f;
    y = y * rest + 1.0f;
    const int32_t power = (static_cast<int32_t>(whole) + 127) << 23;
    float scale;
    __builtin_memcpy(&scale, &power, sizeof scale);
    return y * scale;
}

// Real spherical harmonics up to degree 1.
inline void set_basis(Ray& ray) {
    constexpr float kDegree0 = 0.282094792f, kDegree1 = 0.488602512f;
    const float* d = ray.direction;
    const float harmonics[4] = {kDegree0, -kDegree1 * d[1], kDegree1 * d[2], -kDegree1 * d[0]};
    for (int i = 0; i < kChannels; ++i) ray.basis[i] = 0.0f;
    ray.basis[0] = 1.0f;
    for (int i = 0; i < 12; ++i) ray.basis[1 + i] = harmonics[i / 3];
}

inline void shade(Floats row, const float* basis, float* color) {
    float all[kLanes];
    store(all, row * load(basis));
    for (int c = 0; c < 3; ++c) color[c] = kColorOffset + ((all[1 + c] + all[4 + c]) + (all[7 + c] + all[10 + c]));
}

// The eight vertices about a position and their weights; corner 4 dx + 2 dy + dz.
struct Corners {
    int32_t rows[8];
    float weights[8];

    Corners(const Grid& grid, int64_t vertex, const float* f) {
        const int64_t across[2] = {static_cast<int64_t>(grid.size[1]) * grid.size[2], grid.size[2]};
        const float x[2] = {1.0f - f[0], f[0]}, y[2] = {1.0f - f[1], f[1]}, z[2] = {1.0f - f[2], f[2]};
        for (int i = 0; i < 8; ++i) {
            rows[i] = grid.links[vertex + (i >> 2) * across[0] + (i >> 1 & 1) * across[1] + (i & 1)];
            weights[i] = x[i >> 2] * y[i >> 1 & 1] * z[i & 1];
        }
    }
};

// Adds the weighted unit vector against the gradient of the interpolated density.
inline void add_normal(const float* densities, const float* f, float weight, float* normal) {
    float gradient[3] = {0.0f, 0.0f, 0.0f};
    for (int i = 0; i < 8; ++i) {
        const int bits[3] = {i >> 2, i >> 1 & 1, i & 1};
        float side[3];
        for (int a = 0; a < 3; ++a) side[a] = bits[a] ? f[a] : 1.0f - f[a];
        for (int a = 0; a < 3; ++a) {
            const float across = side[(a + 1) % 3] * side[(a + 2) % 3] * densities[i];
            gradient[a] += bits[a] ? across : -across;
        }
    }
    const float length =
        __builtin_sqrtf(gradient[0] * gradient[0] + gradient[1] * gradient[1] + gradient[2] * gradient[2]);
    if (!(length > 0.0f)) return;
    for (int a = 0; a < 3; ++a) normal[a] -= weight * gradient[a] / length;
}

inline int trace(const Grid& grid, Ray& ray, Sample* samples, Pixel& pixel) {
    set_basis(ray);
    shade(load(grid.background), ray.basis, ray.background);
    float inverse[3], enter = 0.0f, leave = 3e38f;
    for (int a = 0; a < 3; ++a) {
        const float d = ray.direction[a];
        inverse[a] = 1.0f / (__builtin_fabsf(d) > 1e-9f ? d : 1e-9f);
        const float low = (0.0f - ray.origin[a]) * inverse[a];
        const float high = (static_cast<float>(grid.size[a] - 1) - ray.origin[a]) * inverse[a];
        enter = __builtin_fmaxf(enter, low < high ? low : high);
        leave = __builtin_fminf(leave, low < high ? high : low);
    }
    pixel = Pixel{};
    float depth_of_light = 0.0f, transmittance = 1.0f;  // the integral of the density, and e to its negative power
    int count = 0;
    int64_t k = 0;
    while (transmittance > kMinTransmittance) {
        const float t = enter + (static_cast<float>(k) + ray.offset) * grid.step;
        if (!(t < leave)) break;
        float fraction[3];
        int cell[3];
        for (int a = 0; a < 3; ++a) {
            const float at = ray.origin[a] + t * ray.direction[a];
            const int last = grid.size[a] - 2;
            cell[a] = at > 0.0f ? static_cast<int>(at) : 0;
            cell[a] = cell[a] < last ? cell[a] : last;
            const float f = at - static_cast<float>(cell[a]);
            fraction[a] = f < 0.0f ? 0.0f : f > 1.0f ? 1.0f : f;
        }
        const int64_t block =
            (static_cast<int64_t>(cell[0] / kBlock) * grid.blocks[1] + cell[1] / kBlock) * grid.blocks[2] +
            cell[2] / kBlock;
        ++k;
        if (!grid.occupied[block]) {
            float exit = leave;
            for (int a = 0; a < 3; ++a) {
                const int wall = (cell[a] / kBlock + (ray.direction[a] > 0.0f)) * kBlock;
                const float at = (static_cast<float>(wall) - ray.origin[a]) * inverse[a];
                exit = at < exit ? at : exit;
            }
            const int64_t next = static_cast<int64_t>((exit - enter) / grid.step - ray.offset);
            k = next > k ? next : k;
            continue;
        }
        const int64_t vertex = (static_cast<int64_t>(cell[0]) * grid.size[1] + cell[1]) * grid.size[2] + cell[2];
        const Corners corners(grid, vertex, fraction);
        float densities[8], density = 0.0f;
        for (int i = 0; i < 8; ++i) {
            const int32_t row = corners.rows[i];
            densities[i] = row < 0 ? 0.0f : grid.values[static_cast<size_t>(row) * kChannels];
            density += corners.weights[i] * densities[i];
        }
        if (!(density > 0.0f)) continue;
        Floats row(0.0f);
        for (int i = 0; i < 8; ++i)
            if (corners.rows[i] >= 0)
                row = row +
                      Floats(corners.weights[i]) * load(grid.values + static_cast<size_t>(corners.rows[i]) * kChannels);
        float color[3];
        shade(row, ray.basis, color);
        const float before = depth_of_light;
        depth_of_light += density * grid.step;
        const float after = exp_minus(depth_of_light), weight = transmittance - after;
        for (int c = 0; c < 3; ++c) pixel.color[c] += weight * color[c];
        if (samples) {
            samples[count] = {
                static_cast<int32_t>(vertex),           cell[0], {fraction[0], fraction[1], fraction[2]}, weight, after,
                {density, color[0], color[1], color[2]}};
        } else {
            pixel.depth += weight * t;
            add_normal(densities, fraction, weight, pixel.normal);
            if (before < kLn2 && depth_of_light >= kLn2) pixel.median = t - grid.step / 2 + (kLn2 - before) / density;
        }
        ++count;
        transmittance = after;
    }
    pixel.transmittance = transmittance;
    for (int c = 0; c < 3; ++c) pixel.color[c] += transmittance * ray.background[c];
    return count;
}

inline float pull_back(const Ray& ray, const Pixel& pixel, const float* target, float step, Sample* samples, int count,
                       float* background) {
    float slope[3], behind[3], error = 0.0f;
    for (int c = 0; c < 3; ++c) {
        const float difference = pixel.color[c] - target[c];
        error += difference * difference;
        slope[c] = 2.0f * difference;
        behind[c] = pixel.transmittance * ray.background[c];  // color from behind the sample, absorbed by those before
        background[c] = pixel.transmittance * slope[c];
    }
    for (int k = count - 1; k >= 0; --k) {
        Sample& sample = samples[k];
        float density = 0.0f;
        for (int c = 0; c < 3; ++c) {
            float& color = sample.channels[1 + c];
            density += slope[c] * (sample.after * color - behind[c]);
            behind[c] += sample.weight * color;
            color = slope[c] * sample.weight;
        }
        sample.channels[0] = step * density;
    }
    return error;
}

inline void scatter(const Grid& grid, const Ray& ray, const Sample* samples, int count, int thread, int threads,
                    float* gradients, uint8_t* touched, float* weights) {
    const auto owned = [=](int x) { return x / kBlock % threads == thread; };
    const Floats basis = load(ray.basis);
    for (int k = 0; k < count; ++k) {
        const Sample& sample = samples[k];
        const bool own[2] = {owned(sample.x), owned(sample.x + 1)};
        if (!own[0] && !own[1]) continue;
        const float* g = sample.channels;
        const float lanes[kLanes] = {g[0], g[1], g[2], g[3], g[1], g[2], g[3], g[1],
                                     g[2], g[3], g[1], g[2], g[3], 0.0f, 0.0f, 0.0f};
        const Floats gradient = load(lanes) * basis;
        const Corners corners(grid, sample.vertex, sample.fraction);
        for (int i = 0; i < 8; ++i) {
            const int32_t row = corners.rows[i];
            if (row < 0 || !own[i >> 2]) continue;
            float* to = gradients + static_cast<size_t>(row) * kChannels;
            store(to, load(to) + Floats(corners.weights[i]) * gradient);
            touched[row] = 1;
            const float weight = corners.weights[i] * sample.weight;
            weights[row] = weights[row] < weight ? weight : weights[row];
        }
    }
}

}  // namespace PCB_SPACE
