// Planes through small neighbourhoods: the eigenvector of the smallest eigenvalue of their covariance.
#pragma once
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <utility>

#include "common/jacobi.h"
#include "common/vec3.h"

namespace pcbench {

struct EigenResult {
    double values[3];  // values[0] is the smallest
    Vec3 smallest;     // unit eigenvector of the smallest
};

inline EigenResult smallest_eigenvector(Symmetric<double> m) {
    const auto rotate = [](double& pp, double& qq, double& pq, double& rp, double& rq, double (&vp)[3],
                           double (&vq)[3]) {
        if (pq == 0.0) return;
        const double theta = (qq - pp) / (2.0 * pq);
        const double tangent = (theta >= 0 ? 1.0 : -1.0) / (std::fabs(theta) + std::sqrt(theta * theta + 1.0));
        rotate_axes(tangent, 1.0, pp, qq, pq, rp, rq, vp, vq);
        pq = 0.0;
    };
    double axes[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
    for (int round = 0; round < 16; ++round) {
        const double off = std::fabs(m.xy) + std::fabs(m.xz) + std::fabs(m.yz);
        const double diagonal = std::fabs(m.xx) + std::fabs(m.yy) + std::fabs(m.zz);
        if (off <= 1e-17 * diagonal) break;
        jacobi_sweep(m, axes, rotate);
    }
    const double values[3] = {m.xx, m.yy, m.zz};
    int smallest = 0;
    for (int i = 1; i < 3; ++i)
        if (values[i] < values[smallest]) smallest = i;
    EigenResult out;
    for (int i = 0; i < 3; ++i) out.values[i] = values[i] > 0 ? values[i] : 0.0;
    std::swap(out.values[0], out.values[smallest]);
    const Vec3 axis = vec3(axes[smallest]);
    const double length = std::sqrt(dot(axis, axis));
    out.smallest = {axis.x / length, axis.y / length, axis.z / length};
    return out;
}

// Fits a plane to each row of indices. Returns false if an index is out of range; the outputs of its row are not
// written.
inline bool plane_fits(const double* points, size_t count, const int64_t* neighbors, size_t rows, size_t k,
                       double* normals, double* variation) {
    bool in_range = true;
#pragma omp parallel for schedule(static, 1024) reduction(&& : in_range)
    for (int64_t row = 0; row < static_cast<int64_t>(rows); ++row) {
        const int64_t* index = neighbors + row * k;
        bool valid = k > 0;
        for (size_t j = 0; j < k; ++j) valid = valid && index[j] >= 0 && static_cast<size_t>(index[j]) < count;
        in_range = in_range && valid;
        if (!valid) continue;
        // Differences to the first neighbour are summed, so that large coordinates lose no precision.
        const Vec3 first = vec3(points + 3 * index[0]);
        Vec3 mean{0, 0, 0};
        for (size_t j = 0; j < k; ++j) mean = mean + (vec3(points + 3 * index[j]) - first);
        mean = {mean.x / k, mean.y / k, mean.z / k};
        Symmetric<double> covariance{};
        for (size_t j = 0; j < k; ++j) {
            const Vec3 d = vec3(points + 3 * index[j]) - first - mean;
            covariance.xx += d.x * d.x, covariance.xy += d.x * d.y, covariance.xz += d.x * d.z;
            covariance.yy += d.y * d.y, covariance.yz += d.y * d.z, covariance.zz += d.z * d.z;
        }
        const EigenResult result = smallest_eigenvector(covariance);
        write(result.smallest, normals + 3 * row);
        const double total = result.values[0] + result.values[1] + result.values[2];
        variation[row] = total > 0 ? result.values[0] / total : 0.0;
    }
    return in_range;
}

}  // namespace pcbench
