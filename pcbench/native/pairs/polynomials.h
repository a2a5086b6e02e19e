// Sums in the normal equations of a polynomial displacement field.
#pragma once
#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>

namespace pcbench {

constexpr size_t kMonomials = 20;  // monomials of three variables up to degree three
constexpr size_t kProducts = 84;   // monomials up to degree six, which include all products of two of the former

// Each monomial but the first is an earlier one times the coordinate of an axis.
struct MonomialStep {
    int64_t earlier, axis;
};

// For the pairs in [begin, end): moments (84, 6), sums of w phi n n', and scores (20, 3), sums of w phi n r.
inline void normal_equations(size_t begin, size_t end, const double* positions, const double* normals,
                             const double* weights, const double* residuals, const MonomialStep* steps, double* moments,
                             double* scores) {
    constexpr size_t kRow[6] = {0, 1, 2, 0, 0, 1}, kColumn[6] = {0, 1, 2, 1, 2, 2};
    // Transposed, so that the inner loops run over monomials.
    std::array<std::array<double, kProducts>, 6> moment_sums{};
    std::array<std::array<double, kMonomials>, 3> score_sums{};
    std::array<double, kProducts> values;
    values[0] = 1.0;
    for (size_t i = begin; i < end; ++i) {
        const double *x = positions + 3 * i, *n = normals + 3 * i, w = weights[i];
        for (size_t a = 1; a < kProducts; ++a) values[a] = values[steps[a - 1].earlier] * x[steps[a - 1].axis];
        for (size_t k = 0; k < 6; ++k) {
            const double outer = w * n[kRow[k]] * n[kColumn[k]];
            for (size_t a = 0; a < kProducts; ++a) moment_sums[k][a] += values[a] * outer;
        }
        for (size_t k = 0; k < 3; ++k) {
            const double residual = n[k] * (w * residuals[i]);
            for (size_t a = 0; a < kMonomials; ++a) score_sums[k][a] += values[a] * residual;
        }
    }
    for (size_t a = 0; a < kProducts; ++a)
        for (size_t k = 0; k < 6; ++k) moments[6 * a + k] = moment_sums[k][a];
    for (size_t a = 0; a < kMonomials; ++a)
        for (size_t k = 0; k < 3; ++k) scores[3 * a + k] = score_sums[k][a];
}

}  // namespace pcbench
