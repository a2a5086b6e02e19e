// Sums that the normal equations of a polynomial displacement field are made of.
#pragma once
#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>

namespace pcbench {

constexpr size_t kMonomials = 20;  // of three variables, up to degree three
constexpr size_t kProducts = 84;   // up to degree six: all that products of two of them can be

// Each monomial but the first is an earlier one times a coordinate.
struct Step {
    int64_t earlier, axis;
};

// For the pairs in [begin, end): moments (84, 6), sums of w phi n n', and scores (20, 3), sums of w phi n r.
inline void normal_equations(size_t begin, size_t end, const double* places, const double* normals,
                             const double* weights, const double* residuals, const Step* steps, double* moments,
                             double* scores) {
    constexpr size_t kRow[6] = {0, 1, 2, 0, 0, 1}, kColumn[6] = {0, 1, 2, 1, 2, 2};
    // Transposed: the inner loops run over monomials.
    std::array<std::array<double, kProducts>, 6> squares{};
    std::array<std::array<double, kMonomials>, 3> sides{};
    std::array<double, kProducts> values;
    values[0] = 1.0;
    for (size_t i = begin; i < end; ++i) {
        const double *x = places + 3 * i, *n = normals + 3 * i, w = weights[i];
        for (size_t a = 1; a < kProducts; ++a) values[a] = values[steps[a - 1].earlier] * x[steps[a - 1].axis];
        for (size_t k = 0; k < 6; ++k) {
            const double pair = w * n[kRow[k]] * n[kColumn[k]];
            for (size_t a = 0; a < kProducts; ++a) squares[k][a] += values[a] * pair;
        }
        for (size_t k = 0; k < 3; ++k) {
            const double side = n[k] * (w * residuals[i]);
            for (size_t a = 0; a < kMonomials; ++a) sides[k][a] += values[a] * side;
        }
    }
    for (size_t a = 0; a < kProducts; ++a)
        for (size_t k = 0; k < 6; ++k) moments[6 * a + k] = squares[k][a];
    for (size_t a = 0; a < kMonomials; ++a)
        for (size_t k = 0; k < 3; ++k) scores[3 * a + k] = sides[k][a];
}

}  // namespace pcbench
