// Sums over pairs of points and their tangent planes, for point-to-plane distances and ICP. Sums are taken over blocks
// of fixed size and then over the blocks in order: the bits do not depend on the number of threads.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "common/vec3.h"

namespace pcbench {

// With fewer pairs, waking threads takes longer than the loop if the processor is shared.
constexpr size_t kMinParallelPairs = size_t{1} << 17;

template <size_t N, typename Add>
std::array<double, N> sum_in_blocks(size_t count, Add add) {
    constexpr size_t kBlockSize = 512;
    const size_t blocks = (count + kBlockSize - 1) / kBlockSize;
    std::vector<std::array<double, N>> parts(blocks);
#pragma omp parallel for schedule(static) if (count > kMinParallelPairs)
    for (size_t b = 0; b < blocks; ++b) {
        std::array<double, N> part{};
        for (size_t i = b * kBlockSize; i < std::min((b + 1) * kBlockSize, count); ++i) add(i, part);
        parts[b] = part;
    }
    std::array<double, N> total{};
    for (const std::array<double, N>& part : parts)
        for (size_t n = 0; n < N; ++n) total[n] += part[n];
    return total;
}

// Rows of an array (N, 3), in order or selected by indices.
struct Rows {
    const double* data;
    const int64_t* indices;  // null: in order
    Vec3 operator[](size_t i) const { return vec3(data + 3 * (indices ? static_cast<size_t>(indices[i]) : i)); }
};

inline void plane_distances(size_t count, Rows queries, Rows closest, Rows normals, double* distances) {
#pragma omp parallel for schedule(static) if (count > kMinParallelPairs)
    for (size_t i = 0; i < count; ++i) distances[i] = dot(queries[i] - closest[i], normals[i]);
}

// Rounds to float32, to infinity beyond its range.
inline double round_to_float32(double exact) {
    return std::fabs(exact) > 3.4028234663852886e38 ? HUGE_VAL : static_cast<float>(exact);
}

// Squared distances from coordinate differences rounded to float32.
inline void rounded_squares(size_t count, Rows queries, Rows closest, double* squares) {
#pragma omp parallel for schedule(static) if (count > kMinParallelPairs)
    for (size_t i = 0; i < count; ++i) {
        const Vec3 difference = queries[i] - closest[i],
                   d{round_to_float32(difference.x), round_to_float32(difference.y), round_to_float32(difference.z)};
        squares[i] = dot(d, d);
    }
}

// Returns the value of a rank, counted from 0; reorders the values.
inline double nth_smallest(std::vector<double>& values, size_t rank) {
    std::nth_element(values.begin(), values.begin() + static_cast<std::ptrdiff_t>(rank), values.end());
    return values[rank];
}

struct WeightSummary {
    size_t pairs_in_range;  // pairs within the maximum correspondence distance
    double sigma;           // 1.4826 times the median of their absolute residuals
};

// Residuals of all pairs along the normals, and weights: 0 beyond the maximum correspondence distance. Within it,
// weights are Tukey's biweight at 95 % efficiency if `robust`, else 1 for the share `kept_share` of pairs with the
// smallest distances.
inline WeightSummary weigh(size_t count, const double* moved, const double* distances, Rows closest, Rows normals,
                           double max_distance, bool robust, double kept_share, double* residuals, double* weights) {
    plane_distances(count, {moved, nullptr}, closest, normals, residuals);
    std::vector<double> values;
    values.reserve(count);
    for (size_t i = 0; i < count; ++i)
        if (distances[i] <= max_distance) values.push_back(std::fabs(residuals[i]));
    const size_t in_range = values.size();
    if (in_range == 0) {
        std::fill_n(weights, count, 0.0);
        return {0, 0.0};
    }
    const double upper = nth_smallest(values, in_range / 2);
    const double lower = in_range % 2 ? upper : *std::max_element(values.begin(), values.begin() + in_range / 2);
    const double sigma = 1.4826 * (0.5 * (lower + upper));
    if (robust) {
        // The lower bounds are for exact copies, whose residuals are only rounding.
        const double width = 4.685 * std::max({sigma, 1e-12 * max_distance, 2.2250738585072014e-308});
#pragma omp parallel for schedule(static) if (count > kMinParallelPairs)
        for (size_t i = 0; i < count; ++i) {
            const double r = residuals[i] / width, remainder = std::max(1 - r * r, 0.0);
            weights[i] = distances[i] <= max_distance ? remainder * remainder : 0.0;
        }
    } else {
        values.clear();
        for (size_t i = 0; i < count; ++i)
            if (distances[i] <= max_distance) values.push_back(distances[i]);
        const double max_kept_distance =
            nth_smallest(values, static_cast<size_t>(kept_share * static_cast<double>(in_range - 1)));
        for (size_t i = 0; i < count; ++i) weights[i] = distances[i] <= max_kept_distance ? 1.0 : 0.0;
    }
    return {in_range, sigma};
}

// Normal equations of sum w (residual + J motion)^2 for one point-to-plane iteration (Chen and Medioni 1992). The
// motion is a rotation about the weighted centre of the pairs, a translation and the logarithm of a scale, each
// expressed as a displacement at the RMS radius of the pairs.
struct PlaneSystem {
    double hessian[7][7], gradient[7];
    double center[3], radius;
};

inline PlaneSystem plane_system(size_t count, const double* moved, Rows normals, const double* residuals,
                                const double* weights) {
    PlaneSystem out{};
    const auto first = sum_in_blocks<4>(count, [&](size_t i, std::array<double, 4>& sum) {
        for (int a = 0; a < 3; ++a) sum[a] += weights[i] * moved[3 * i + a];
        sum[3] += weights[i];
    });
    for (int a = 0; a < 3; ++a) out.center[a] = first[3] > 0 ? first[a] / first[3] : 0.0;
    const auto second = sum_in_blocks<36>(count, [&](size_t i, std::array<double, 36>& sum) {
        const double w = weights[i];
        if (w == 0) return;
        const Vec3 n = normals[i], a = vec3(moved + 3 * i) - vec3(out.center), moment = cross(a, n);
        const double row[7] = {moment.x, moment.y, moment.z, n.x, n.y, n.z, dot(a, n)};
        size_t at = 0;
        for (int r = 0; r < 7; ++r)
            for (int c = r; c < 7; ++c) sum[at++] += w * row[r] * row[c];
        for (int r = 0; r < 7; ++r) sum[28 + r] += w * row[r] * residuals[i];
        sum[35] += w * dot(a, a);
    });
    out.radius = first[3] > 0 ? std::sqrt(second[35] / first[3]) : 0.0;
    if (!(out.radius > 0)) out.radius = 1.0;
    const auto unit = [&](int r) { return r < 3 || r == 6 ? 1 / out.radius : 1.0; };
    size_t at = 0;
    for (int r = 0; r < 7; ++r) {
        for (int c = r; c < 7; ++c) out.hessian[r][c] = out.hessian[c][r] = second[at++] * unit(r) * unit(c);
        out.gradient[r] = second[28 + r] * unit(r);
    }
    return out;
}

}  // namespace pcbench
