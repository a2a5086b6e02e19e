// Planes through small neighbourhoods: the eigenvector of the smallest eigenvalue of their covariance.
#pragma once
#include <cmath>
#include <cstddef>
#include <cstdint>

namespace pcbench {

struct Vec3 {
    double x, y, z;
};

inline Vec3 cross(const Vec3& a, const Vec3& b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
inline double dot(const Vec3& a, const Vec3& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

// Symmetric 3x3 eigenproblem by cyclic Jacobi rotations: slower than the closed form, but accurate to the last
// digits for the nearly singular covariances that planes have (the closed form loses half of them).
inline void smallest_eigenvector(double a[3][3], Vec3& vector, double values[3]) {
    double v[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
    for (int sweep = 0; sweep < 16; ++sweep) {
        const double off = std::fabs(a[0][1]) + std::fabs(a[0][2]) + std::fabs(a[1][2]);
        const double diagonal = std::fabs(a[0][0]) + std::fabs(a[1][1]) + std::fabs(a[2][2]);
        if (off <= 1e-17 * diagonal) break;
        for (int p = 0; p < 2; ++p)
            for (int q = p + 1; q < 3; ++q) {
                if (a[p][q] == 0.0) continue;
                const double theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
                const double t = (theta >= 0 ? 1.0 : -1.0) / (std::fabs(theta) + std::sqrt(theta * theta + 1.0));
                const double c = 1.0 / std::sqrt(t * t + 1.0), s = t * c;
                const int r = 3 - p - q;
                const double apq = a[p][q], arp = a[r][p], arq = a[r][q];
                a[p][p] -= t * apq;
                a[q][q] += t * apq;
                a[p][q] = a[q][p] = 0.0;
                a[r][p] = a[p][r] = c * arp - s * arq;
                a[r][q] = a[q][r] = s * arp + c * arq;
                for (int i = 0; i < 3; ++i) {
                    const double vip = v[i][p], viq = v[i][q];
                    v[i][p] = c * vip - s * viq;
                    v[i][q] = s * vip + c * viq;
                }
            }
    }
    int smallest = 0;
    for (int i = 1; i < 3; ++i)
        if (a[i][i] < a[smallest][smallest]) smallest = i;
    for (int i = 0; i < 3; ++i) values[i] = a[i][i] > 0 ? a[i][i] : 0.0;
    const Vec3 column{v[0][smallest], v[1][smallest], v[2][smallest]};
    const double norm = std::sqrt(dot(column, column));
    vector = {column.x / norm, column.y / norm, column.z / norm};
    const double keep = values[0];
    values[0] = values[smallest];
    values[smallest] = keep;
}

// One row of indices a neighbourhood; false when an index is out of range (its row is left as it was).
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
        // Differences to the first neighbour before anything is summed: large coordinates cost no digits.
        const double* first = points + 3 * index[0];
        Vec3 mean{0, 0, 0};
        for (size_t j = 0; j < k; ++j) {
            const double* p = points + 3 * index[j];
            mean.x += p[0] - first[0];
            mean.y += p[1] - first[1];
            mean.z += p[2] - first[2];
        }
        mean = {mean.x / k, mean.y / k, mean.z / k};
        double c[3][3] = {};
        for (size_t j = 0; j < k; ++j) {
            const double* p = points + 3 * index[j];
            const double d[3] = {p[0] - first[0] - mean.x, p[1] - first[1] - mean.y, p[2] - first[2] - mean.z};
            for (int a = 0; a < 3; ++a)
                for (int b = a; b < 3; ++b) c[a][b] += d[a] * d[b];
        }
        c[1][0] = c[0][1], c[2][0] = c[0][2], c[2][1] = c[1][2];
        Vec3 normal;
        double values[3];
        smallest_eigenvector(c, normal, values);
        normals[3 * row] = normal.x, normals[3 * row + 1] = normal.y, normals[3 * row + 2] = normal.z;
        const double total = values[0] + values[1] + values[2];
        variation[row] = total > 0 ? values[0] / total : 0.0;
    }
    return in_range;
}

}  // namespace pcbench
